"""Export to TorchScript: a traced network in a thin scripted shell.

The shell's `forward` takes the contract's mapping, a `Dict[str, Tensor]` in which frame numbers may be
missing, and returns the color. Tracing alone could not express the defaults, and scripting alone would ask
every network to be written in TorchScript's subset of Python.
"""

from __future__ import annotations

import io
from typing import Dict, List, cast  # noqa: UP035 - TorchScript reads these annotations

import torch
from torch import Tensor, nn

from data.buffers import sample_channels
from models.denoiser import Denoiser
from trainer.export.description import Description
from trainer.export.entry import Entry, Sampled, default, example, first_state, tracing

EXTRA_FILE = "penumbra.json"


class Guarded(nn.Module):
    """What shells share: they check the names and fill in frame numbers that are missing.

    Weights in loops over rows (`models.ops.loops`) are constants: `torch.jit.load(…, map_location=device)`
    brings all to a device, `module.to(device)` does not.

    Attributes:
        inputs: Names of the buffers.
        sample_channels: Channels of `samples`, in order; empty where it is not read.
        states: Maps of the state, in order; empty where there is none.
    """

    def __init__(
        self,
        core: nn.Module,
        inputs: tuple[str, ...],
        defaults: dict[str, Tensor],
        sample_channels: tuple[str, ...],
        states: tuple[str, ...] = (),
    ) -> None:
        super().__init__()
        self.states = cast(list[str], torch.jit.Attribute(list(states), List[str]))  # noqa: UP006
        self.core = core
        self.inputs = list(inputs)
        self.sample_channels = cast(list[str], torch.jit.Attribute(list(sample_channels), List[str]))  # noqa: UP006
        # TorchScript cannot infer the type of an empty dictionary.
        self.defaults = cast(dict[str, Tensor], torch.jit.Attribute(defaults, Dict[str, Tensor]))  # noqa: UP006

    def known(self, buffers: Dict[str, Tensor]) -> Dict[str, Tensor]:  # noqa: UP006
        """Return what the network is called with."""
        known: Dict[str, Tensor] = {}  # noqa: UP006
        for name in self.inputs:
            if name not in buffers:
                raise ValueError("missing buffer " + name)
            known[name] = buffers[name]
            if name == "samples":
                shape, channels = buffers[name].shape, self.sample_channels
                if len(shape) != 5 or shape[1] == 0 or shape[2] != len(channels):
                    raise ValueError(
                        "samples must be (B, S, C, H, W) with the channels " + ", ".join(channels)
                    )
        device = buffers[self.inputs[0]].device
        for name, value in self.defaults.items():
            known[name] = buffers[name] if name in buffers else value.to(device)
        for name in self.states:
            if name not in buffers:
                raise ValueError("missing state " + name + "; zeros start a sequence")
            known[name] = buffers[name]
        return known


class Shell(Guarded):
    """The shell of a network: buffers in, color out."""

    def forward(self, buffers: Dict[str, Tensor]) -> Tensor:  # noqa: UP006
        """Return the color (B, 3, H, W)."""
        return self.core(self.known(buffers))


class RecurrentShell(Guarded):
    """The shell of a recurrent network: buffers and state in, color and next state out."""

    def forward(self, buffers: Dict[str, Tensor]) -> List[Tensor]:  # noqa: UP006
        """Return the color (B, 3, H, W) and the maps of the next state, in the order of `states`."""
        return self.core(self.known(buffers))


def build(denoiser: Denoiser) -> tuple[torch.jit.ScriptModule, list[str]]:
    """Return the scripted shell of a prepared denoiser, and what the tracer doubted."""
    given = {name: default(name) for name in denoiser.frame_numbers}
    buffers = example(denoiser.inputs, 2, 48, 32, samples=Sampled(denoiser.samples, 3))
    buffers |= {name: v.repeat_interleave(2, 0) for name, v in given.items()}
    states = first_state(denoiser.state_maps, 2, 48, 32, denoiser.multiple)
    buffers |= states
    channels = sample_channels(*denoiser.samples)
    kind = RecurrentShell if states else Shell
    with tracing() as doubts, torch.no_grad():
        core = torch.jit.trace(Entry(denoiser).eval(), (buffers,), check_trace=False)
        shell = kind(core, tuple(denoiser.inputs), given, channels, tuple(states))
        module = torch.jit.script(shell.eval())
    return module, doubts


def serialise(module: torch.jit.ScriptModule, description: Description) -> bytes:
    """Return the archive with its description."""
    stream = io.BytesIO()
    with tracing():
        torch.jit.save(module, stream, _extra_files={EXTRA_FILE: description.to_json()})
    return stream.getvalue()
