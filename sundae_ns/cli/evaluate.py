"""``sundae eval``: metrics of a finished run on its test views."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.outputs import Overwrite, check_file
from sundae_ns.cli.process import loading


def evaluate(
    run: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    data: Path | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Evaluate a finished run on its test views, and write the metrics in the format of ns-eval.

    Names that end in _base are without the head, and those in _std are deviations over the views. Unlike ns-eval, this
    runs no code of the run's config.yml.

    Args:
        run: a run of sundae or splatfacto (its folder or config.yml).
        out: file to write, such as eval.json.
        data: folder of the capture, if it moved.
        overwrite: replace an existing file.
    """
    from sundae_ns.storage.atomic import write_text
    from sundae_ns.storage.config_file import check_run
    from sundae_ns.storage.run_folder import files_of

    check_file(out, reads=[*files_of(run), data], overwrite=overwrite)
    check_run(run)
    with loading(), redirect_stdout(StringIO()):  # nerfstudio prints messages while it loads
        from sundae_ns.scenes.measure import evaluation

        found = evaluation(run, data=data)
    write_text(out, json.dumps(found, indent=2, allow_nan=False) + "\n")
    results = found["results"]
    figures = [f"{name.upper()} {results[name]:.4g}" for name in ("psnr", "ssim", "lpips") if results.get(name)]
    print(f"{out}: {', '.join(figures)}, means over the test views")
    return 0
