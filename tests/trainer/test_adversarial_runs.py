"""Adversarial training as a run: resuming, averaged weights, logs, divergence, precision, refusals."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies import FSDPStrategy, SingleDeviceStrategy
from torch.utils.data import DataLoader

from models import AFGSA
from tests.synthetic import Patches, Synthetic, patch
from tests.trainer.stand_ins import BrokenCritic, LogNet, SmoothCritic, SplitNet, fit, module, trainer
from trainer.callbacks import FiniteGuard, LastCheckpoint, TrainingProgress
from trainer.schedules import Halving

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval"),
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists and is not empty"),  # resumed
]


class Resumable(Synthetic):
    """Goes on after the batches that the trainer has finished, as the loader of shards does."""

    def train_dataloader(self):
        data = self

        class Continued(DataLoader):
            def __iter__(self):
                progress = data.trainer.fit_loop.epoch_loop.batch_progress
                yield from list(super().__iter__())[progress.current.ready :]

            def state_dict(self):
                return {}

            def load_state_dict(self, state):
                pass

        return Continued(Patches(self.count, 100), self.batch_size)


class KilledError(Exception):
    pass


def saving(folder, every=1):
    callback = LastCheckpoint(every_n_train_steps=every)
    callback.dirpath = str(folder)
    return callback


def run(folder, kill_at=None, resume=False, average=False, epochs=2, **options):
    """Train 2 epochs of 6 batches; returns the last checkpoint."""
    trained = module(lr_scheduler=partial(Halving, milestones=[4], per="step"), **options)
    callbacks = [EMAWeightAveraging(decay=0.5)] if average else []
    made = trainer(folder, [*callbacks, saving(folder)], max_epochs=epochs)
    if kill_at is not None:
        ordinary = trained.training_step

        def killed(batch, batch_idx):
            if trained.global_step == kill_at:
                raise KilledError
            return ordinary(batch, batch_idx)

        trained.training_step = killed
    path = folder / "last.ckpt"
    made.fit(trained, datamodule=Resumable(2, 12), ckpt_path=path if resume else None, weights_only=True)
    return torch.load(path, weights_only=True)


def same(one, other):
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


@pytest.mark.parametrize(
    ("kill_at", "options"),
    [
        (4, {}),
        (8, {"average": True}),
        (2, {"accumulate": 2}),
        (1, {"critic_steps": 3, "critic_first": False}),
        (4, {"net": SplitNet, "frozen_steps": {"base": 5}}),
    ],
)
def test_killed_run_continues_in_mid_epoch_to_identical_weights_and_optimizers(tmp_path, kill_at, options):
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = run(tmp_path / "whole", **options)
    with pytest.raises(KilledError):
        run(tmp_path / "parts", kill_at, **options)
    assert torch.load(tmp_path / "parts" / "last.ckpt", weights_only=True)["global_step"] == kill_at
    parts = run(tmp_path / "parts", resume=True, **options)
    assert any(name.startswith("critics.") for name in whole["state_dict"])
    kept = ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "current_model_state")
    for key in kept:
        assert same(whole.get(key), parts.get(key)), key


def test_averaged_denoiser_is_what_is_validated_and_saved(tmp_path):
    trained = module(optimizer=partial(torch.optim.Adam, lr=0.05))
    seen = []
    trained.validation_loss = lambda *_: (
        seen.append(trained.net.base.weight.detach().clone()) or torch.ones(())
    )
    made = trainer(tmp_path, [EMAWeightAveraging(decay=0.9), saving(tmp_path, every=3)], limit_val_batches=1)
    made.fit(trained, datamodule=Synthetic(2, 6))
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert not torch.equal(
        saved["current_model_state"]["net.base.weight"], saved["state_dict"]["net.base.weight"]
    )
    assert torch.equal(seen[0], saved["state_dict"]["net.base.weight"])
    assert torch.equal(trained.net.base.weight, saved["state_dict"]["net.base.weight"])


def test_checkpoints_lie_at_the_denoisers_steps(tmp_path):
    steps = []

    class Noting(LastCheckpoint):
        def _save_checkpoint(self, trainer, filepath):
            steps.append((trainer.global_step, trainer.fit_loop.epoch_loop.batch_idx))
            super()._save_checkpoint(trainer, filepath)

    callback = Noting(every_n_train_steps=2)
    callback.dirpath = str(tmp_path)
    made = trainer(tmp_path, [callback])
    made.fit(module(accumulate=2, critic_steps=2), datamodule=Synthetic(1, 16))
    assert made.global_step == 4
    assert steps == [(2, 7), (4, 15)]


class Book(Logger):
    """Keeps what is logged."""

    name = version = "book"

    def __init__(self):
        super().__init__()
        self.rows = []

    def log_hyperparams(self, *arguments):
        pass

    def log_metrics(self, metrics, step=None):
        self.rows.append((step, metrics))


def test_numbers_of_both_sides_are_logged_once_per_step_of_the_denoiser():
    book = Book()
    made = trainer(logger=book)
    made.fit(module(SplitNet, critic_steps=2, accumulate=2), datamodule=Synthetic(1, 16))
    metrics = {name: value for _, row in book.rows for name, value in row.items()}
    pairs = ("", "/diffuse", "/specular")
    expected = {f"{name}{pair}" for name in ("train/l1", "train/adversarial") for pair in pairs}
    expected |= {f"critic/{name}{pair}" for name in ("loss", "gap", "penalty") for pair in pairs}
    expected |= {"train/loss_step", "train/loss_epoch", "train/gradient_norm", "critic/gradient_norm"}
    assert expected <= set(metrics)
    for name in sorted(expected - {"train/loss_epoch"}):
        assert [step for step, row in book.rows if name in row] == [0, 1, 2, 3], name
    for name in ("train/l1", "train/adversarial", "critic/loss", "critic/gap", "critic/penalty"):
        assert metrics[name] == pytest.approx(
            metrics[f"{name}/diffuse"] + metrics[f"{name}/specular"], rel=1e-5
        )
    total = metrics["train/l1"] + 0.005 * metrics["train/adversarial"]
    assert metrics["train/loss_step"] == pytest.approx(total, rel=1e-5)
    assert metrics["critic/loss"] == pytest.approx(
        -metrics["critic/gap"] / 2 + 10 * metrics["critic/penalty"], rel=1e-5
    )


def test_progress_shows_loss_gap_and_the_denoisers_steps(tmp_path, capsys):
    made = trainer(tmp_path, [TrainingProgress(plain_interval_s=0.0)], enable_progress_bar=True)
    made.fit(module(critic_steps=2), datamodule=Synthetic(2, 8))
    line = next(line for line in capsys.readouterr().err.splitlines() if "step 2/2" in line)
    assert "loss" in line
    assert "gap" in line


@pytest.mark.parametrize(
    ("factor", "reason"),
    [
        (float("nan"), r"critic/loss became nan at step 3; the batch itself is finite"),
        (1e9, r"critic/gap became .*, beyond divergence_limit 1e\+06, at step 3"),
    ],
)
def test_diverging_critic_stops_before_weights_are_spoiled_with_the_batch_saved(
    tmp_path, monkeypatch, factor, reason
):
    monkeypatch.chdir(tmp_path)
    # Four calls per step: real, fake, between, and for the denoiser.
    trained = module(critic=partial(BrokenCritic, after=8, factor=factor))
    sound = module(critic=partial(BrokenCritic, after=8, factor=factor))
    fit(sound, count=4)
    with pytest.raises(ValueError, match=reason) as caught:
        fit(trained, callbacks=[FiniteGuard()], enable_checkpointing=False)
    assert "--model.critic.init_args.norm none" in str(caught.value)
    assert "--trainer.gradient_clip_val" not in str(caught.value)
    saved = torch.load(tmp_path / "diverged-step3-rank0.pt", weights_only=True)
    assert saved["frame"].tolist() == [104, 105]
    for name, tensor in sound.state_dict().items():
        assert torch.equal(tensor, trained.state_dict()[name]), name


def test_batch_that_is_not_finite_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bad = patch(0) | {"reference": torch.full((3, 32, 32), float("inf"))}
    made = trainer(tmp_path)
    trained = module()
    with pytest.raises(ValueError, match=r"became (nan|inf) at step 2; not finite in the batch: reference"):
        made.fit(trained, DataLoader([patch(1), bad], 1), DataLoader([bad]))
    assert all(torch.isfinite(p).all() for p in trained.parameters())


class Fireflies(Synthetic):
    """High dynamic range with single pixels of up to 65504."""

    def train_dataloader(self):
        generator = torch.Generator().manual_seed(9)
        made = []
        for seed in range(self.count):
            one = patch(seed)
            fire = torch.rand(1, 32, 32, generator=generator) < 0.002
            one["color"] = torch.where(fire, 65504.0, one["color"] * 30)
            one["reference"] = one["reference"] * 30
            made.append(one)
        return DataLoader(made, self.batch_size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("net", "rate"),
    [(partial(LogNet, width=8), 3e-3), (partial(AFGSA, width=16, blocks=1, checkpointed=1), 1e-3)],
)
def test_fifty_steps_in_bfloat16_stay_near_those_in_float32(net, rate):
    losses = {}
    for precision in ("32-true", "bf16-mixed"):
        trained = module(net, optimizer=partial(torch.optim.Adam, lr=rate))
        numbers = []
        taken = trained.training_step

        def step(batch, batch_idx, taken=taken, numbers=numbers):
            result = taken(batch, batch_idx)
            numbers.append([float(result["loss"]), float(result["gap"])])
            return result

        trained.training_step = step
        made = trainer(max_epochs=5, precision=precision)
        made.fit(trained, datamodule=Fireflies(2, 20))
        assert made.global_step == 50
        losses[precision] = torch.tensor(numbers)
    exact, rounded = losses.values()
    assert torch.isfinite(rounded).all()
    assert not torch.equal(exact, rounded)
    assert exact[-10:, 0].mean() < 0.95 * exact[:10, 0].mean()
    assert torch.allclose(exact[:, 0], rounded[:, 0], rtol=0.02)
    assert torch.allclose(exact[:, 1], rounded[:, 1], rtol=0.05, atol=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"adversarial_weight": -1}, "adversarial_weight is -1, expected at least 0"),
        ({"penalty_weight": float("nan")}, "penalty_weight is nan"),
        ({"critic_steps": 0}, "critic_steps is 0, expected more than 0"),
        ({"accumulate": 0}, "accumulate is 0"),
        ({"gradient_clip": 0.0}, "gradient_clip is 0.0"),
        (
            {"lr_scales": {"cfm": 5.0}},
            "lr_scales: LogNet has no parameter group 'cfm', it has base, modulation",
        ),
        ({"lr_scales": {"base": 0.0}}, "lr_scales: base is 0.0, expected more than 0"),
        ({"frozen_steps": {"base": -1}}, "frozen_steps: base is -1, expected at least 0"),
    ],
)
def test_wrong_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        module(**options)


@pytest.mark.parametrize("precision", ["16-mixed", "16-true", "bf16-true"])
def test_precision_that_the_penalty_exceeds_is_refused_with_what_works(precision):
    # Without a GPU Lightning itself would turn 16-mixed into bf16-mixed.
    trained = module()
    trained.trainer = SimpleNamespace(strategy=SingleDeviceStrategy(), precision=precision)
    with pytest.raises(
        ValueError, match=rf"precision {precision}.*--trainer.precision bf16-mixed or 32-true"
    ):
        trained.setup("fit")
    trained.setup("test")


def test_strategy_that_divides_a_network_is_refused_with_what_works():
    trained = module()
    trained.trainer = SimpleNamespace(strategy=FSDPStrategy(), precision="32-true")
    with pytest.raises(ValueError, match=r"on one device or with --trainer.strategy ddp"):
        trained.setup("fit")


@pytest.mark.parametrize(
    "options", [{"adversarial_weight": 0.0}, {"critic": partial(SmoothCritic, width=5)}, {"net": SplitNet}]
)
def test_denoiser_of_a_run_is_evaluated_without_its_critics_or_with_others(tmp_path, options):
    fit(module(), folder=tmp_path, callbacks=[saving(tmp_path)])
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)["state_dict"]
    other = module(**options)
    critics = {name: value.clone() for name, value in other.critics.state_dict().items()}
    made = trainer(tmp_path, [saving(tmp_path)], limit_val_batches=1)
    made.validate(other, Synthetic(2, 4), tmp_path / "last.ckpt", verbose=False, weights_only=True)
    assert all(torch.equal(saved[f"net.{name}"], value) for name, value in other.net.state_dict().items())
    assert same(critics, dict(other.critics.state_dict()))


def test_schedule_that_waits_for_a_score_is_refused():
    with pytest.raises(ValueError, match="Adversarial cannot use ReduceLROnPlateau"):
        fit(module(lr_scheduler=torch.optim.lr_scheduler.ReduceLROnPlateau))


def test_trainer_is_given_back_as_it_came():
    trained = module(accumulate=2, critic_steps=2)
    made = fit(trained, count=8)
    assert made.accumulate_grad_batches == 1
    made.validate(trained, datamodule=Synthetic(2, 4), verbose=False)
