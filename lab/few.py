"""quality.py on a capture cut by cut.py, whose test views are named eval_*: python lab/few.py CAPTURE -o DIR ..."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import quality  # noqa: E402
from harness.run import run_script  # noqa: E402

plain = quality.parser_of


def parser_of(data, downscale):
    words = list(plain(data, downscale))
    at = words.index("interval")
    return type(plain(data, downscale))([*words[:at], "filename", *words[at + 3 :]])


quality.parser_of = parser_of
run_script(quality.QualityOptions, quality.__doc__, quality.run_quality)
