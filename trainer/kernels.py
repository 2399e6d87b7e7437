"""Compiled kernels of the training-free methods, as far as a user notices them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from trainer.inputs import Say
from trainer.loading import Model


class Kernels:
    """Whether a model runs in kernels that Numba compiles.

    Args:
        model: The model.
        device: Where it runs; there are kernels for the CPU only.
    """

    def __init__(self, model: Model, device: str) -> None:
        self.wanted = getattr(model, "fused", False) is not False and device == "cpu"
        self.there = importlib.util.find_spec("numba") is not None

    @property
    def hint(self) -> str:
        """What would make slow frames faster, empty where nothing would."""
        if not self.wanted or self.there:
            return ""
        return (
            "this runs in plain PyTorch; with Numba it is about ten times faster: "
            "pip install 'penumbra-denoise[fast]'"
        )

    @contextmanager
    def announced(self, say: Say) -> Iterator[None]:
        """Say it when kernels are compiled for the first time, which takes a while in silence."""
        if not (self.wanted and self.there):
            yield
            return
        from numba.core import event

        class Listener(event.Listener):
            def on_start(self, event: Any) -> None:
                say("compiling kernels for this machine, once; this takes up to a minute")

            def on_end(self, event: Any) -> None:
                """Nothing to say."""

        with event.install_listener("numba:compile", Listener()):
            yield
