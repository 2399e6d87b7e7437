"""Training of recurrent denoisers: unrolled losses, tests frame by frame, resuming."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as lightning
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from models import RAE, WSKP
from tests.synthetic import Synthetic, patch
from trainer.callbacks import LastCheckpoint
from trainer.losses import Recurrent
from trainer.modules import Regression, Sequence
from trainer.modules.sequence import frames
from trainer.schedules import InverseRoot
from trainer.training import check_clips

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval"),
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists and is not empty"),  # resumed
]

FRAMES = 3
MOVING = ("irradiance", "albedo", "normal", "depth", "color", "reference", "depth_range")


def clip(seed: int) -> dict[str, Any]:
    """A sequence: the same window of three frames."""
    images = [patch(1000 * seed + number, 16) for number in range(FRAMES)]
    whole = {**images[0], "scene": "plane" if seed % 2 else "step"}
    return {**whole, **{name: torch.stack([image[name] for image in images]) for name in MOVING}}


class Clips(Dataset[dict[str, Any]]):
    def __init__(self, count: int, first: int) -> None:
        self.count, self.first = count, first

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        return clip(self.first + index)


class Sequences(Synthetic):
    """Clips; goes on after the batches that the trainer has finished, as the loader of shards does."""

    def train_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        data = self

        class Continued(DataLoader[dict[str, Tensor]]):
            def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
                assert isinstance(data.trainer, lightning.Trainer)
                yield from list(super().__iter__())[
                    data.trainer.fit_loop.epoch_loop.batch_progress.current.ready :
                ]

            def state_dict(self) -> dict[str, Any]:
                return {}

            def load_state_dict(self, state: dict[str, Any]) -> None:
                pass

        return Continued(Clips(self.count, 100), self.batch_size)

    def val_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        return DataLoader(Clips(4, 0), self.batch_size)


def module(**options: Any) -> Sequence:
    torch.manual_seed(5)
    return Sequence(RAE(stages=(4, 5), tail=(6, 5)), **options)


def trainer(folder: Path, **options: Any) -> lightning.Trainer:
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    options = {"max_epochs": 2, "log_every_n_steps": 1, "enable_checkpointing": False, **options}
    return lightning.Trainer(accelerator="cpu", default_root_dir=folder, **quiet, **options)


def batch(*seeds: int) -> dict[str, Any]:
    return next(iter(DataLoader([clip(seed) for seed in seeds], len(seeds))))  # type: ignore[arg-type]


def test_the_loss_is_that_of_the_unrolled_sequence() -> None:
    trained = module()
    trained.log = lambda *_, **__: None  # type: ignore[method-assign]
    trained._trainer = None
    trained.count_loss = lambda loss: None  # type: ignore[method-assign]
    given, state = batch(1, 2), None
    outputs, targets = [], []
    for number in range(FRAMES):
        moving = {name: given[name][:, number] for name in MOVING}
        pair, result = trained.net.next_pair({**moving, "exposure": given["exposure"]}, state)
        state = result.state
        outputs.append(pair.output)
        targets.append(pair.target)
    expected = Recurrent()(torch.stack(outputs, 1), torch.stack(targets, 1))
    assert trained.training_step(given, 0).item() == pytest.approx(expected.item(), rel=1e-6)


def test_every_frame_is_scored_and_the_loss_falls(tmp_path: Path) -> None:
    trained = module(optimizer=partial(torch.optim.Adam, lr=0.01))
    data = Sequences(4, 16)
    made = trainer(tmp_path, max_epochs=8)
    made.fit(trained, datamodule=data)
    before = trainer(tmp_path).validate(module(), datamodule=data, verbose=False)[0]
    after = trainer(tmp_path).validate(trained, datamodule=data, verbose=False)[0]
    assert after["val/loss"] < 0.7 * before["val/loss"]
    scored = []
    trained.scores = None
    start = trained.on_validation_epoch_start

    def watched() -> None:
        start()
        assert trained.scores is not None
        update = trained.scores.update
        trained.scores.update = lambda *given: scored.extend(given[2]) or update(*given)  # type: ignore[method-assign,func-returns-value]

    trained.on_validation_epoch_start = watched  # type: ignore[method-assign]
    trainer(tmp_path).validate(trained, datamodule=data, verbose=False)
    assert len(scored) == 4 * FRAMES


def test_tests_carry_the_state_until_scene_or_order_ends() -> None:
    trained = module().eval()
    places = [("a", 0), ("a", 1), ("a", 3), ("b", 4), ("b", 5)]
    images = [next(iter(DataLoader([patch(seed)]))) for seed in range(5)]  # type: ignore[arg-type]
    carried = []
    with torch.no_grad():
        for (scene, number), image in zip(places, images, strict=True):
            given = {**image, "scene": [scene], "frame": torch.tensor([number])}
            alone = trained.net({name: image[name] for name in (*trained.net.inputs, "depth_range")}).color
            carried.append(not torch.equal(trained(given).color, alone))
    assert carried == [False, True, False, False, True]


def test_views_and_frames_that_count_nowhere_are_first_ones(tmp_path: Path) -> None:
    carried = []

    class Watched(Sequence):
        def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
            alone = self.net({name: batch[name] for name in (*self.net.inputs, "depth_range")}).color
            carried.append(not torch.equal(self(batch).color, alone))

    class Views(Synthetic):
        def independent_views(self, split: str) -> tuple[str, ...]:
            return ("plane",) if split == "test" else ()

        def test_dataloader(self) -> DataLoader[dict[str, Any]]:
            scenes = (["step"], ["step"], ["plane"], ["plane"], [], [])
            images = [next(iter(DataLoader([patch(place)]))) for place in range(6)]  # type: ignore[arg-type]
            batches = [{**image, "scene": scene} for image, scene in zip(images, scenes, strict=True)]
            return DataLoader(batches, None)  # type: ignore[arg-type]

    torch.manual_seed(5)
    watched = Watched(RAE(stages=(4, 5), tail=(6, 5)))
    watched.on_test_epoch_end = lambda: None  # type: ignore[method-assign]  # there are no scores
    trainer(tmp_path).test(watched, datamodule=Views(), verbose=False)
    assert carried == [False, True, False, False, False, False]


def test_a_test_on_several_ranks_needs_whole_scenes() -> None:
    tested = module()
    for whole, world in ((True, 2), (False, 1)):
        tested.check_ranks(SimpleNamespace(whole_scenes=whole), world)
    with pytest.raises(
        ValueError, match=r"2 processes would get every other frame .* --data\.whole_scenes true"
    ):
        tested.check_ranks(SimpleNamespace(whole_scenes=False), 2)


def test_clips_and_images_for_the_wrong_training_are_refused_before_anything_is_prepared() -> None:
    clips, images = SimpleNamespace(frames=7), SimpleNamespace(frames=1)
    check_clips(module(), clips)
    check_clips(Regression(WSKP()), images)
    for trained in (module(), Regression(WSKP())):
        check_clips(trained, Synthetic())  # says nothing of clips
    with pytest.raises(ValueError, match=r"Sequence trains on clips, .* use --data\.recipe recurrent"):
        check_clips(module(), images)
    with pytest.raises(ValueError, match="Regression trains on single frames, and the data are clips of 7"):
        check_clips(Regression(WSKP()), clips)


def test_a_picture_shows_the_last_frame() -> None:
    trained, given = module().eval(), batch(3)
    with torch.no_grad():
        image, result = trained.pictured(given)
        *_, (_, expected) = trained.unrolled(given)
    assert torch.equal(image["reference"], given["reference"][:, -1])
    assert torch.equal(result.color, expected.color)


class KilledError(Exception):
    pass


def run(folder: Path, kill_at: int | None = None, resume: bool = False) -> dict[str, Any]:
    """Train 2 epochs of 6 batches; returns the last checkpoint."""
    trained = module(lr_scheduler=partial(InverseRoot, warmup=1))
    saving = LastCheckpoint(every_n_train_steps=1)
    saving.dirpath = str(folder)
    made = trainer(folder, callbacks=[saving], enable_checkpointing=True, limit_val_batches=0)
    ordinary = trained.training_step

    def killed(batch: dict[str, Any], batch_idx: int) -> Tensor:
        if trained.global_step == kill_at:
            raise KilledError
        return ordinary(batch, batch_idx)

    trained.training_step = killed  # type: ignore[method-assign]
    path = folder / "last.ckpt"
    made.fit(trained, datamodule=Sequences(2, 12), ckpt_path=path if resume else None, weights_only=True)
    saved: dict[str, Any] = torch.load(path, weights_only=True)
    return saved


def test_a_killed_run_continues_to_identical_weights(tmp_path: Path) -> None:
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = run(tmp_path / "whole")
    with pytest.raises(KilledError):
        run(tmp_path / "parts", kill_at=8)
    parts = run(tmp_path / "parts", resume=True)
    assert whole["global_step"] == parts["global_step"] == 12
    for name, tensor in whole["state_dict"].items():
        assert torch.equal(tensor, parts["state_dict"][name]), name
    assert whole["lr_schedulers"] == parts["lr_schedulers"]


def test_networks_without_state_are_refused() -> None:
    with pytest.raises(ValueError, match="WSKP carries no state from frame to frame; use Regression"):
        Sequence(WSKP())


def test_batches_of_images_are_refused() -> None:
    image = next(iter(DataLoader([patch(1)])))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"--data\.recipe recurrent"):
        list(frames(image))
