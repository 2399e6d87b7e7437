"""The data module: shards of frames as batches for training, validation and test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from lightning.pytorch import LightningDataModule

from data.augment import Augmentation, Rule
from data.buffers import SAMPLES, buffer
from data.frames import FrameSet
from data.manifest import load_manifest
from data.needs import beside, explain_lacking, patch_number
from data.progress import LineProgress
from data.root import Root, resolve_root
from data.shards.batch import Batches
from data.shards.cache import ShardCache
from data.shards.index import Index
from data.shards.loader import EvaluationLoader, TrainingLoader
from data.shards.options import recipe_options
from data.shards.prepare import cached_path, prepare_cached
from data.shards.read import CorruptSampleError, Sample, ShardReader
from data.shards.shapes import available

Loader = TrainingLoader | EvaluationLoader


class Shards(LightningDataModule):
    """Patches for training and validation, whole frames for test, from shards.

    A batch is a dictionary: each buffer as float32 (B, C, H, W), raw linear values; `exposure` (B,) and
    `depth_range` (B, 2) of the whole frame; `scene` and `key`, lists of str; `frame` (B,) int64.

    With `frames` N above 1, training and validation samples are clips, the same window of N consecutive
    frames: buffers (B, N, C, H, W), `depth_range` (B, N, 2), `exposure` and `frame` of the clip's first
    frame as it was rendered. Test samples are single frames as ever.

    Every rank sees the same number of training batches, and different samples; the order follows from seed
    and epoch, not from the number of workers, and a run continues with the next batch in the middle of an
    epoch. Validation and test read every sample once over all ranks.

    Args:
        root: `sample:NAME`, a folder of shards, the URL of one (`s3://BUCKET/SHARDS`,
            `https://HOST/SHARDS`), or an ingested folder, which is prepared into `$PENUMBRA_CACHE` (default
            ~/.cache/penumbra) before the first use.
        batch_size: Samples per batch and rank; test has batches of one frame.
        workers: Processes that read, per rank; 0 reads in the training process.
        seed: Seed of order and augmentation, and of patch positions where the root is prepared here.
        augment: Change training patches as the options below say; off, they stay as they are.
        augment_rule: `wskp`: with probability 0.5 one of two flips and two quarter turns; `dihedral`: one of
            the eight symmetries of a square.
        exposure_stops: Vary the exposure of training patches by up to so many stops up and down.
        permute: Permute colour channels and world axes of training patches.
        drop_history: Share of training patches whose input is not accumulated.
        train_patches: Training patches per 1280x720 frame, where the root is prepared here; with the recipe
            `afgsa` the candidates, of which about two thirds are kept. None: as the recipe says, 80 as in
            WSKP without one; for a sample, whose frames are few and small, `data.sample.TRAIN_PATCHES`,
            `data.sample.CANDIDATES`, `data.sample.CROPS` or `data.sample.CLIP_PATCHES`.
        validation_patches: Validation patches per 1280x720 frame, where the root is prepared here; None: as
            the recipe says, 20 without one.
        patch_size: Width and height of patches, where the root is prepared here.
        on_corrupt: What to do about a damaged sample: `raise` an error, or `skip` it, with a warning for
            each.
        verify: Compare each sample with its checksum when a process reads it for the first time.
        buffers: Buffers that the network reads; these and `targets` are delivered, in evaluation also
            `color` and `history`. None: all that the shards hold. The command line fills it in from the
            network. Where the root is prepared here, they are among what is stored.
        targets: Buffers that training compares with. The command line fills it in from the network.
        temporal: Deliver `irradiance` accumulated over preceding frames as stored, otherwise color / albedo
            of the frame alone. The command line fills it in from the network.
        recipe: How the root is prepared here, `bmfr`, `afgsa`, `layers` or `recurrent` (see `trainer prepare
            --help`); None: as WSKP, with whatever samples the frames keep apart.
        sample_counts: Fewest and most samples per pixel that a training batch keeps, drawn anew for each
            batch, where frames keep samples apart; None: all.
        spp: Use only frames with these samples per pixel, where the root is prepared here; None: all.
        cache_gb: Where the root is a URL, size of the copies of shards in `$PENUMBRA_CACHE`, for all runs of
            this machine together. Samples of shards that do not fit are read over the network each time.
        frames: Consecutive frames of a training or validation sample; shards that are given must have as
            many. None: as the recipe says, 1 without one.
        reverse: Share of training clips that run backward.
        freeze: Share of training clips that repeat one of their frames, from there to the end.
        whole_scenes: In test, all frames of a scene go to one rank, in order, as networks with a memory need
            them, instead of each to the next rank.

    Where shards hold the samples of each pixel, a batch has `samples` (B, S, C, H, W), `sample_channels`, a
    list of C names such as `radiance.R`, and `thin_lens` (B, 3), aperture radius, focus distance and field of
    view, 0 where unknown. Samples turn with the image (`data.augment_samples`). Those that do not count are
    NaN, so that a pixel may have none, the more of them the fewer `sample_counts` leave.
    """

    def __init__(
        self,
        root: str = "sample:bmfr",
        batch_size: int = 8,
        workers: int = 1,
        seed: int = 1,
        augment: bool = True,
        augment_rule: Rule = "wskp",
        exposure_stops: float = 0.0,
        permute: bool = False,
        drop_history: float = 0.0,
        train_patches: int | None = None,
        validation_patches: int | None = None,
        patch_size: int = 128,
        on_corrupt: Literal["raise", "skip"] = "raise",
        verify: bool = True,
        buffers: Sequence[str] | None = None,
        temporal: bool = True,
        recipe: Literal["bmfr", "afgsa", "layers", "recurrent"] | None = None,
        spp: Sequence[int] | None = None,
        targets: Sequence[str] = ("reference",),
        sample_counts: tuple[int, int] | None = None,
        cache_gb: float = 50.0,
        frames: int | None = None,
        reverse: float = 0.0,
        freeze: float = 0.0,
        whole_scenes: bool = False,
    ) -> None:
        super().__init__()
        if batch_size < 1 or workers < 0:
            raise ValueError(f"batch_size {batch_size} and workers {workers}: expected at least 1 and 0")
        if on_corrupt not in ("raise", "skip"):
            raise ValueError(f"on_corrupt is {on_corrupt!r}; expected 'raise' or 'skip'")
        if not cache_gb > 0:
            raise ValueError(f"cache_gb is {cache_gb}; expected gigabytes, more than 0")
        self.root, self.cache_gb = root, cache_gb
        self.batch_size, self.workers, self.seed = batch_size, workers, seed
        changes = (augment_rule, exposure_stops, seed, permute, drop_history, sample_counts, reverse, freeze)
        self.augmentation = (
            Augmentation(*changes) if augment else Augmentation("none", seed=seed, samples=sample_counts)
        )
        self.targets = tuple(dict.fromkeys(("reference", *targets)))
        explicit = {
            "patch_size": patch_size,
            "validation_patches": validation_patches,
            "seed": seed,
            "spp": None if spp is None else tuple(spp),
            "frames": frames,
            "buffers": beside(recipe, (*(buffers or ()), *self.targets)) or None,
            **patch_number(root, recipe, train_patches),
        }
        self.options = recipe_options(recipe, explicit)
        self.frames, self.whole_scenes = self.options.frames, whole_scenes
        if self.frames == 1 and max(reverse, freeze) > 0:
            raise ValueError(
                "reverse and freeze change clips, and samples are single frames; name frames, or recipe "
                "recurrent"
            )
        self.on_corrupt, self.verify = on_corrupt, verify
        for name in (*(buffers or ()), *targets):
            if name != SAMPLES:
                buffer(name)
        self.buffers = None if buffers is None else tuple(buffers)
        self.temporal = temporal
        # Ranks with an odd sample less have an evaluation batch less, and with few frames none.
        self.allow_zero_length_dataloader_with_multiple_devices = True
        self._index: Index | None = None
        self._resolved: Root | None = None
        self._loaders: dict[str, Loader] = {}

    @property
    def index(self) -> Index:
        """Index of the shards, once they are prepared.

        Raises:
            ValueError: The root is no data set; the message says which command to run.
            OSError: The root does not exist, or is a URL that cannot be read.
        """
        if self._index is None:
            found = self._find_root()
            path = found.path if found.kind == "shards" else cached_path(found.path, self.options)
            if found.url is not None:
                self._index = Index.read_remote(found.url, path)
            else:
                self._index = Index.read(path, check_sizes=self.on_corrupt == "raise")
        return self._index

    def _find_root(self) -> Root:
        if self._resolved is None:
            self._resolved = resolve_root(self.root)
        return self._resolved

    @property
    def manifest_hash(self) -> str:
        """Hash of the manifest of the frames, the same whether they are prepared yet or not."""
        found = self._find_root()
        return load_manifest(found.path).hash if found.kind == "frames" else self.index.manifest_hash

    def scenes(self, split: str) -> tuple[str, ...]:
        """Return the scenes of a split, in order."""
        return tuple(self.index.scenes(split))

    def independent_views(self, split: str) -> tuple[str, ...]:
        """Return the scenes of a split whose frames do not follow one another as they come, in order."""
        found = self.index.manifest["scenes"]

        def independent(scene: str) -> bool:
            views = [frame["view"] for frame in found[scene]["frames"] if "view" in frame]
            return not found[scene]["sequence"] or len(set(views)) < len(views)

        return tuple(scene for scene in self.scenes(split) if independent(scene))

    def counts(self) -> dict[str, int]:
        """Return the number of samples of each split."""
        return {split: self.index.count(split) for split in ("train", "validation", "test")}

    @property
    def corrupt(self) -> dict[str, str]:
        """Damaged samples that were left out so far, with the reason."""
        return {name: why for loader in self._loaders.values() for name, why in loader.corrupt.items()}

    def prepare_data(self) -> None:
        """Prepare an ingested root into the cache, in one process per node.

        Raises:
            ValueError: A frame lacks a buffer that the network reads or is compared with.
        """
        found = self._find_root()
        if found.kind == "frames":
            if lacking := FrameSet(found.path).lacking(self.options.buffers):
                raise ValueError(explain_lacking(self._reader(), found.path, *lacking))
            prepare_cached(found.path, self.options, LineProgress(f"preparing {found.path.name}"))

    def setup(self, stage: str) -> None:
        """Open the index and check that it can serve what is asked.

        Raises:
            ValueError: A split that is needed is empty, or a buffer is missing.
        """
        needed = {"fit": ("train",), "validate": ("validation",), "test": ("test",)}.get(stage, ())
        for split in needed:
            if self.index.count(split) == 0:
                raise ValueError(
                    f"{self.index.place} has no samples in split {split!r}; prepare it from frames whose "
                    "manifest has a scene for it"
                )

    def train_dataloader(self) -> TrainingLoader:
        """Return the loader of training patches of this rank."""
        batches = self._batches("train", self.augmentation)
        rank, world = self._place()
        loader = TrainingLoader(
            batches,
            self.batch_size,
            self.seed,
            rank=rank,
            world=world,
            workers=self.workers,
            pin_memory=self._on_gpu(),
            done=self._done if self.trainer is not None else None,
            fixed_order=self._overfits(),
        )
        return self._keep("train", loader)

    def val_dataloader(self) -> EvaluationLoader | list[Any]:
        """Return the loader of this rank's validation patches or clips; nothing where there are none."""
        return self._evaluation("validation", self.batch_size)

    def test_dataloader(self) -> EvaluationLoader | list[Any]:
        """Return the loader of this rank's whole test frames, one at a time in the order of scene and frame;
        with `whole_scenes` those of whole scenes."""
        return self._evaluation("test", 1)

    def teardown(self, stage: str) -> None:
        """End the worker processes."""
        for loader in self._loaders.values():
            loader.close()

    def _reader(self) -> str:
        """Return what to call whoever reads the batches, in messages."""
        net = getattr(getattr(self.trainer, "lightning_module", None), "net", None)
        return "the network" if net is None else type(net).__name__

    def _evaluation(self, split: str, batch_size: int) -> EvaluationLoader | list[Any]:
        if self.index.count(split) == 0:
            return []
        rank, world = self._place()
        loader = EvaluationLoader(
            self._batches(split, None),
            batch_size,
            rank=rank,
            world=world,
            workers=self.workers,
            pin_memory=self._on_gpu(),
            whole_scenes=self.whole_scenes and split == "test",
        )
        return self._keep(split, loader)

    def _batches(self, split: str, augmentation: Augmentation | None) -> Batches:
        index = self.index
        if split != "test" and index.frames != self.frames:
            # Who trains on clips cannot take single frames instead, nor the other way round.
            fits = min(index.frames, self.frames) > 1
            raise ValueError(
                f"{index.place} holds {_samples_text(index.frames)}, and {_samples_text(self.frames)} are to "
                f"be read: {f'set --data.frames {index.frames}, or ' if fits else ''}prepare again: trainer "
                f"prepare FRAMES --output SHARDS --clip-frames {self.frames}"
            )
        cache = None if index.url is None else ShardCache(index, round(self.cache_gb * 1e9))
        reader = ShardReader(index, split, self.verify, cache)
        names = self._names(reader, evaluation=augmentation is None)
        return Batches(reader, names, self.temporal, self.buffers or (), augmentation, self.on_corrupt)

    def _names(self, reader: ShardReader, evaluation: bool) -> tuple[str, ...]:
        sample = self._first_readable(reader)
        held = available(sample)
        wanted = held if self.buffers is None else (*self.buffers, *self.targets)
        missing = [name for name in wanted if name not in held]
        if SAMPLES in missing:
            raise ValueError(
                f"{self.index.place} has no samples of each pixel, which the network reads; render or ingest "
                "frames that keep them apart, and prepare those"
            )
        if missing:
            raise ValueError(
                f"{self.index.place} has no buffer {', '.join(missing)}; its {reader.split} samples hold "
                f"{', '.join(sample.buffers)}. Prepare again: trainer prepare FRAMES --output SHARDS "
                f"--buffers {','.join(missing)}"
            )
        pictures = [name for name in ("color", "history") if evaluation and name in held]
        return tuple(dict.fromkeys([*wanted, *pictures]))

    def _first_readable(self, reader: ShardReader) -> Sample:
        for number in range(len(reader)):
            try:
                return reader.sample(number)
            except CorruptSampleError:
                if self.on_corrupt == "raise":
                    raise
        raise ValueError(f"{self.index.place} has no {reader.split} sample that can be read")

    def _keep(self, split: str, loader: Any) -> Any:
        if split in self._loaders:
            self._loaders[split].close()
        self._loaders[split] = loader
        return loader

    def _place(self) -> tuple[int, int]:
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)

    def _on_gpu(self) -> bool:
        return self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"

    def _overfits(self) -> bool:
        return bool(getattr(self.trainer, "overfit_batches", 0))

    def _done(self) -> int:
        """Return how many batches of this epoch are finished; Lightning restores the number when it
        resumes."""
        assert self.trainer is not None
        return int(self.trainer.fit_loop.epoch_loop.batch_progress.current.ready)


def _samples_text(frames: int) -> str:
    return "single frames" if frames == 1 else f"clips of {frames} frames"
