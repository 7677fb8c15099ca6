import torch

from sundae_ns.storage.accounting import Sizes, bytes_of, bytes_of_module, megabytes


def test_primitives_count_as_fp32_for_any_dtype():
    params = {"means": torch.zeros(10, 3), "features_rest": torch.zeros(10, 15, 3), "features": torch.zeros(10, 13)}
    assert bytes_of(params) == 10 * (3 + 45 + 13) * 4
    assert bytes_of({name: value.half() for name, value in params.items()}) == bytes_of(params)
    assert bytes_of({}) == 0


def test_module_counts_parameters_and_buffers_in_their_dtype():
    module = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.BatchNorm1d(8))
    parameters, buffers = 4 * 8 + 8 + 8 + 8, 8 + 8
    counter = 8  # BatchNorm counts its batches in one int64
    assert bytes_of_module(module) == 4 * (parameters + buffers) + counter
    assert bytes_of_module(module.half()) == 2 * (parameters + buffers) + counter


def test_shared_tensors_count_once():
    a, b = torch.nn.Linear(3, 3, bias=False), torch.nn.Linear(3, 3, bias=False)
    b.weight = a.weight
    assert bytes_of_module(torch.nn.ModuleList([a, b])) == 36


def test_sizes():
    sizes = Sizes(primitives=23_600_000, head=7_800_000)
    assert sizes.total == 31_400_000
    assert megabytes(sizes.total) == "31.40 MB"
    assert Sizes(5).total == 5
