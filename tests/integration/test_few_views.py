"""A run of few views starts from more points than its sparse cloud, and resumes without looking for them again."""

import torch

from sundae_ns.train import initialize


def test_a_whole_run_and_its_resume(trainer_of, capsys, monkeypatch, tiny):
    monkeypatch.setitem(initialize.SIDES, "cpu", 48)
    monkeypatch.setitem(initialize.FILLED, "cpu", 800)

    def change(config):
        config.pipeline.model.dense_start_views = 12
        config.steps_per_save, config.save_only_latest_checkpoint, config.max_num_iterations = 5, False, 10

    whole = trainer_of(change)
    whole.train()
    assert whole.model.num_points == tiny.points + 500
    assert "500 points by a plane sweep beside 300 sparse ones" in " ".join(capsys.readouterr().out.split())

    def resume(config):
        change(config)
        config.timestamp, config.load_dir, config.load_step, config.max_num_iterations = (
            "resumed",
            whole.checkpoint_dir,
            5,
            4,
        )

    monkeypatch.setattr(initialize, "Sweep", None)
    resumed = trainer_of(resume)
    resumed.train()
    for name, value in whole.model.gauss_params.items():
        assert torch.equal(resumed.model.gauss_params[name], value), name
