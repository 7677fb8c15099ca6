import numpy as np
import pytest
import torch
from PIL import Image

from sundae_ns.errors import DataError
from sundae_ns.evaluation import ComparisonRow, comparison_sheet
from sundae_ns.evaluation.comparison_image import _CAPTION, _GAP


def _images(height=6, width=8):
    truth = torch.full((height, width, 3), 0.4)
    return truth, truth + 0.2, truth - 0.08


def _tiles(row):
    """The four enlarged tiles of a sheet with one row."""
    sheet = np.asarray(comparison_sheet([row]))
    width = (sheet.shape[1] - 5 * _GAP) // 4
    tiles = sheet[_CAPTION : -_CAPTION - _GAP]
    return [tiles[:, _GAP + i * (width + _GAP) :][:, :width] for i in range(4)]


def test_tiles_and_amplified_error():
    tiles = _tiles(ComparisonRow(*_images()))
    assert {(tile.dtype.name, tile.shape) for tile in tiles} == {("uint8", (6 * 30, 8 * 30, 3))}
    assert [np.unique(tile).tolist() for tile in tiles] == [[102], [153], [82], [102]]


def test_values_out_of_range_are_clipped():
    truth = np.zeros((4, 4, 3))
    tiles = _tiles(ComparisonRow(truth, truth - 1, truth + 2))
    assert [np.unique(tile).tolist() for tile in tiles] == [[0], [0], [255], [255]]


def test_sheet_enlarges_without_mixing_pixels():
    truth = torch.zeros(4, 5, 3)
    truth[1, 2] = torch.tensor([1.0, 0.0, 0.0])
    sheet = np.asarray(comparison_sheet([ComparisonRow(truth, truth, truth)]))
    factor = 240 // 5
    red = (sheet == [255, 0, 0]).all(axis=2)
    assert red.sum() == 3 * factor**2  # truth, base and compensated, but not the error
    black = (sheet == 0).all(axis=2)
    assert black.sum() == (3 * 19 + 20) * factor**2


def test_captions_change_with_the_quality():
    truth, base, compensated = _images()
    one = np.asarray(comparison_sheet([ComparisonRow(truth, base, compensated)]))
    other = np.asarray(comparison_sheet([ComparisonRow(truth, base, compensated, title="a view")]))
    assert one.shape == other.shape
    assert (one != other).any()


def test_rows_of_different_sizes_fit(tmp_path):
    rows = [ComparisonRow(*_images(6, 8), "small"), ComparisonRow(*_images(30, 300), "wide")]
    comparison_sheet(rows).save(tmp_path / "a.png")
    saved = Image.open(tmp_path / "a.png")
    np.testing.assert_array_equal(np.asarray(saved), np.asarray(comparison_sheet(rows)))
    assert saved.width > 4 * 300


def test_unusable_images():
    truth, base, compensated = _images()
    with pytest.raises(DataError, match="shapes"):
        comparison_sheet([ComparisonRow(truth, base[:3], compensated)])
    with pytest.raises(DataError, match="shapes"):
        comparison_sheet([ComparisonRow(truth[..., 0], base[..., 0], compensated[..., 0])])
    with pytest.raises(DataError, match="nothing"):
        comparison_sheet([])
