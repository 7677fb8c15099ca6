import logging
import urllib.error
import urllib.request

import pytest
import torch
import torchmetrics.image

from sundae_ns.evaluation import Lpips, lpips_weights_available, lpips_weights_path


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch.hub folder."""
    before = torch.hub._hub_dir
    torch.hub.set_dir(str(tmp_path))
    yield tmp_path
    torch.hub._hub_dir = before


@pytest.fixture
def offline(monkeypatch):
    calls = []

    def refuse(*_, timeout, **__):
        calls.append(timeout)
        raise urllib.error.URLError("no network")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)
    return calls


def _put_random_weights(net="alex"):
    from torchvision.models import alexnet

    path = lpips_weights_path(net)
    path.parent.mkdir(parents=True)
    # The file's name carries a hash, but torch.hub checks it only while downloading.
    torch.save(alexnet(weights=None).state_dict(), path)


def test_without_weights_there_is_one_warning_and_no_error(hub, offline, caplog):
    metric, image = Lpips(), torch.rand(40, 40, 3)
    assert not lpips_weights_available()
    with caplog.at_level(logging.WARNING):
        assert [metric(image, image) for _ in range(3)] == [None] * 3
    assert len(offline) == 1
    assert 0 < offline[0] <= 10
    (record,) = caplog.records
    message = record.getMessage()
    assert "no network" in message
    assert "alexnet-owt" in message
    assert str(hub / "checkpoints") in message
    assert "\n" not in message


def test_downloads_can_be_off(hub, offline):
    assert Lpips(download=False)(torch.rand(40, 40, 3), torch.rand(40, 40, 3)) is None
    assert offline == []


def test_damaged_weights_do_not_end_the_run(hub, offline, caplog):
    path = lpips_weights_path()
    path.parent.mkdir(parents=True)
    path.write_bytes(b"not a checkpoint")
    assert lpips_weights_available()
    assert Lpips()(torch.rand(40, 40, 3), torch.rand(40, 40, 3)) is None
    assert len(caplog.records) == 1
    assert offline == []


def test_small_images_have_no_lpips_and_need_no_weights(hub, offline, caplog):
    assert Lpips()(torch.rand(31, 60, 3), torch.rand(31, 60, 3)) is None
    assert offline == []
    assert caplog.records == []


def test_weights_on_disk_are_used_without_the_network(hub, offline, monkeypatch):
    torch.manual_seed(0)
    _put_random_weights()
    built = []
    original = torchmetrics.image.LearnedPerceptualImagePatchSimilarity
    monkeypatch.setattr(
        torchmetrics.image,
        "LearnedPerceptualImagePatchSimilarity",
        lambda **kwargs: built.append(kwargs) or original(**kwargs),
    )
    metric, target = Lpips(), torch.rand(32, 48, 3)
    assert built == []
    same, near, far = (metric((target + noise * torch.randn(32, 48, 3)), target) for noise in (0, 0.05, 0.5))
    assert built == [{"net_type": "alex", "normalize": True}]
    assert offline == []
    assert same == 0
    assert 0 < near < far
    assert not far.requires_grad
    assert metric(target, target) == 0  # earlier calls leave no state
