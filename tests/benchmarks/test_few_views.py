"""Captures that are cut to few training views, and the rows of what is measured on them."""

from itertools import combinations_with_replacement

import few_views
import numpy as np
import pytest
from colmap_models import write_model
from few_views import colmap

from harness.plan import parser_of
from harness.rows import read_rows
from sundae_ns.core.errors import ConfigError, DataError


@pytest.mark.parametrize("tests", [range(0, 20, 8), (3, 4, 12)])
def test_a_cut_has_all_test_views_and_the_points_that_two_of_its_training_views_see(tmp_path, tests):
    names = [f"{i:02}.png" if tests[0] == 0 else f"{'eval' if i in tests else 'train'}_{i:02}.png" for i in range(20)]
    capture, model, out = tmp_path / "a", tmp_path / "a" / "sparse" / "0", tmp_path / "a-3"
    write_model(model, names, (8, 6))
    cameras, images, points = colmap.read_model(str(model), ext=".bin")
    pairs = dict(enumerate(combinations_with_replacement(images, 2)))  # a point of each: two views, or one twice
    points = {i: points[0]._replace(id=i, image_ids=np.array(ids), point2D_idxs=ids) for i, ids in pairs.items()}
    colmap.write_model(cameras, images, points, str(model), ext=".bin")
    (capture / "images").mkdir()
    for image in images.values():
        (capture / "images" / image.name).write_text(str(image.id))
    few_views.cut(capture, 3, out)
    _, kept, seen = colmap.read_model(str(out / "sparse" / "0"), ext=".bin")
    assert all((out / "images" / image.name).read_text() == str(i) for i, image in kept.items())
    train, test = ({i for i, image in kept.items() if image.name.startswith(kind)} for kind in ("train_", "eval_"))
    assert (len(train), test) == (3, {1 + i for i in tests})
    assert (parser_of(out)[-1], parser_of(capture)[-1]) == ("filename", "filename" if tests[0] else "8")
    assert all((kept[i].tvec == images[i].tvec).all() for i in kept)
    assert {frozenset(pairs[i]) for i in seen} == {frozenset({a, b}) for a in train for b in train if a != b}
    with pytest.raises(DataError, match="has 17 training views, not 18; give other --views"):
        few_views.cut(capture, 18, tmp_path / "a-18")
    assert {path.name for path in tmp_path.iterdir()} == {"a", "a-3"}


def test_rows_of_a_suite_replace_those_of_the_same_cut_seed_and_arm(tmp_path, monkeypatch):
    def run_suite(options):
        options.out.mkdir(exist_ok=True)
        rows = [f"{name},{arm},42,9,,30.12345,0.9" for name in options.scenes for arm in options.arms]
        (options.out / "results.csv").write_text(
            "\n".join(["scene,variant,seed,primitives,bytes_head,psnr,ssim", *rows])
        )
        return 1

    monkeypatch.setattr(few_views, "run_suite", run_suite)

    def cut(capture, _, out):
        out.mkdir()  # fails for one that is there
        (out / "capture.txt").write_text(str(capture))

    monkeypatch.setattr(few_views, "cut", cut)
    table = tmp_path / "few.csv"
    for views, arms in (((12, 16), ("splatfacto",)), ((12,), ("splatfacto", "sundae-auto"))):
        assert few_views.main((tmp_path / "fox",), out=tmp_path, views=views, arms=arms, table=table) == 1
    (tmp_path / "captures" / "fox-16" / "capture.txt").unlink()
    for names in (("fox", "other/fox"), ("other/fox",), ("fox",), ("dog",)):
        arms = ("splatfakto" if names == ("dog",) else "splatfacto",)
        with pytest.raises(ConfigError, match="named alike|-12 is a cut of .*other|an earlier version;|splatfakto is"):
            few_views.main(tuple(tmp_path / name for name in names), out=tmp_path, arms=arms, table=table)
    assert {path.name for path in (tmp_path / "captures").iterdir()} == {"fox-12", "fox-16"}
    found = [(row["capture"], row["views"], row["arm"], row["head"], row["psnr"]) for row in read_rows(table)]
    places = [("16", "splatfacto"), ("12", "splatfacto"), ("12", "default")]
    assert found == [("fox", *place, "off", "30.123") for place in places]
