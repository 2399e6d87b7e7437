"""Altered checkpoints: each must be read, or refused with a ValueError or OSError, whatever it says.

    python -m tests.fuzz.checkpoints 20000        the figure of `make fuzz`
    python -m tests.fuzz.checkpoints 1 SEED 1234  one input, in this process, with its traceback

Inputs are made from small checkpoints of `trainer fit` and of the authors of WSKP. Hyper-parameters and names
are replaced, also by paths of classes and functions from elsewhere; numbers, opcodes and functions of the
pickle are changed; records of the archive are cut, swapped, doubled and compressed; bytes are turned. Each
goes through what `--model`, `--ckpt_path` and a resumed training do before they use it.
"""

from __future__ import annotations

import io
import json
import pickletools
import random
import sys
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import torch

from models import WSKP
from tests.fuzz import batches
from tests.fuzz.bytewise import Files, numbered, turned
from tests.fuzz.shards import VALUES, _altered
from trainer.loading import load_model
from trainer.training import check_checkpoint

FILE = "last.ckpt"
BOUND = 64 << 20
TREE = {"class_path": "models.WSKP", "init_args": {"layers": 2, "width": 4, "kernel_sizes": [3, 5]}}
FOREIGN = (
    *("os.system", "subprocess.Popen", "builtins.eval", "torch.nn.Linear", "torch.nn.Transformer"),
    *("models.NFOR", "models.KPCN", "models.Layer", "models.Denoiser", "models.wskp.WSKP", "this.s"),
    *("unittest.__main__.main", "torch.jit.load", "tests.fuzz.trap.Net", "", ".", "models.", "x" * 500),
)
FUNCTIONS = (
    *("os system", "builtins eval", "builtins bytearray", "collections Counter", "_codecs encode"),
    *("torch._utils _rebuild_tensor", "torch._utils _rebuild_sparse_tensor", "torch._utils _rebuild_qtensor"),
    *("torch._utils _rebuild_meta_tensor_no_storage", "torch._utils _rebuild_parameter", "torch Tensor"),
    *("torch.storage UntypedStorage", "torch DoubleStorage", "torch Size", "torch device", "torch float64"),
)
EXTRA = {
    "epoch": 3,
    "global_step": 12,
    "pytorch-lightning_version": "2.6.6",
    "loops": {"fit_loop": {"state_dict": {}}},
}


class Configured:
    """Stands for the network that a configuration asks for."""

    @staticmethod
    def as_dict() -> dict[str, Any]:
        """Return the tree of the base."""
        return TREE


def extra(folder: Path) -> int:
    """Return the bytes that reading may take beside `BOUND`: four times the file."""
    return 4 * (folder / FILE).stat().st_size


def read_all(folder: Path) -> None:
    """Do with a checkpoint what commands do.

    Raises:
        ValueError: It is refused.
        OSError: It is refused.
    """
    path = folder / FILE
    load_model(str(path))
    check_checkpoint(path, Configured, "")


@cache
def trees() -> tuple[dict[str, Any], ...]:
    """Return the content of the checkpoints that are altered."""
    torch.manual_seed(1)
    network = WSKP(**TREE["init_args"])  # type: ignore[arg-type]
    state = {f"net.{name}": value for name, value in network.state_dict().items()}
    moments = {0: {"step": torch.tensor(3.0), "exp_avg": torch.zeros(4, 4)}}
    optimizer = [{"state": moments, "param_groups": [{"lr": 1e-3, "params": [0]}]}]
    parameters = {"net": TREE, "lr": 1e-3, "adversarial_weight": 0.0, "critic": None}
    training = {**EXTRA, "state_dict": state, "hyper_parameters": parameters, "optimizer_states": optimizer}
    plain = {"class_path": "models.JointBilateral", "init_args": {}}
    return training, {"hyper_parameters": {"net": plain}, "state_dict": {}}


def bases() -> list[Files]:
    """Return the files that are altered; only the first has the network that is configured."""
    return [{FILE: _saved(trees()[0])}]


def _saved(content: Any) -> bytes:
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


def mutated(made: list[Files], seed: int, number: int) -> Files:
    """Return input `number`: a checkpoint altered in one to three places."""
    chance = random.Random(f"{seed} {number}")
    way = chance.random()
    if way < 0.3:
        content: Any = chance.choice(trees()[:1] * 3 + trees()[1:])
        for _ in range(chance.choice((1, 1, 2, 3))):
            content = _changed(chance, content)
        return {FILE: _saved(content)}
    data = made[0][FILE]
    if way < 0.85:
        members = dict(_members(data))
        for _ in range(chance.choice((1, 1, 1, 2, 3))):
            _alter(chance, members)
        data = _packed(chance, members)
    if way >= 0.75:
        for _ in range(chance.choice((1, 1, 2, 4))):
            # The directory at the end, or anything.
            data = turned(chance, data, max(0, len(data) - 1200) if chance.random() < 0.5 else 0)
    return {FILE: data}


def _changed(chance: random.Random, content: Any) -> Any:
    """Change a value of what is stored: the network's arguments most often."""
    if not isinstance(content, dict) or chance.random() < 0.2:
        return _altered(chance, content)
    content = dict(content)
    parameters = content.get("hyper_parameters")
    if not isinstance(parameters, dict) or chance.random() < 0.2:
        state = content.get("state_dict")
        if isinstance(state, dict) and state:
            name = chance.choice(list(state))
            other = (None, torch.zeros(1).expand(1 << 30), torch.zeros(4).to_sparse(), 3, torch.zeros(0))
            content["state_dict"] = {**state, name: chance.choice((*other, chance.choice(VALUES)))}
        return content
    tree = parameters.get("net")
    if isinstance(tree, dict) and chance.random() < 0.8:
        arguments = tree.get("init_args")
        how = chance.random()
        if how < 0.3:
            tree = {**tree, "class_path": chance.choice(FOREIGN)}
        elif how < 0.8 and isinstance(arguments, dict):
            name = chance.choice((*arguments, "layers", "width", "kernel_sizes", "x"))
            nested = {
                "class_path": chance.choice(FOREIGN),
                "init_args": {"in_features": 1 << 30, "out_features": 9},
            }
            value = chance.choice((*VALUES, 1 << 20, 100_000, [1 << 20], [1001], nested, nested, nested))
            tree = {**tree, "init_args": {**arguments, name: value}}
        else:
            tree = _altered(chance, tree)
        content["hyper_parameters"] = {**parameters, "net": tree}
    else:
        content["hyper_parameters"] = _altered(chance, parameters)
    return content


@cache
def _members(data: bytes) -> tuple[tuple[str, bytes], ...]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return tuple((name, archive.read(name)) for name in archive.namelist())


def _alter(chance: random.Random, members: dict[str, bytes]) -> None:
    """Change the pickle, a record, or which records there are."""
    way = chance.random()
    pickled = next((name for name in members if name.endswith("data.pkl")), None)
    if pickled is not None and way < 0.7:
        members[pickled] = _repickled(chance, members[pickled])
        return
    name = chance.choice(list(members))
    if way < 0.8:
        members[name] = turned(chance, members[name])
    elif way < 0.85:
        del members[name]
    elif way < 0.9:
        members[name] = members[chance.choice(list(members))]
    elif way < 0.95:
        members[chance.choice(("../../evil", "/etc/evil", "archive/constants.pkl", name + "x"))] = (
            members.pop(name)
        )
    else:
        members[name] = bytes(1 << chance.choice((10, 16, 22)))
    if not members:
        members["archive/data.pkl"] = b""


def _repickled(chance: random.Random, data: bytes) -> bytes:
    """Return a pickle with another number, opcode, function or byte."""
    try:
        steps = [(op.name, place) for op, _, place in pickletools.genops(data)]
    except ValueError:
        return turned(chance, data)
    way = chance.random()
    sizes = {
        "BININT1": 1,
        "BININT2": 2,
        "BININT": 4,
        "BINPUT": 1,
        "LONG_BINPUT": 4,
        "BINGET": 1,
        "LONG_BINGET": 4,
    }
    if way < 0.35:
        name, place = chance.choice([step for step in steps if step[0] in sizes] or [("BININT1", 0)])
        return numbered(chance, data, place + 1, sizes[name])
    if way < 0.45:  # a larger number than the opcode of the base holds
        _, place = chance.choice([step for step in steps if step[0] == "BININT1"] or [("", 0)])
        number = chance.choice((1 << 16, 1 << 24, 1 << 30, (1 << 31) - 1))
        return data[:place] + b"J" + number.to_bytes(4, "little") + data[place + 2 :]
    if way < 0.6:
        _, place = chance.choice([step for step in steps if step[0] == "GLOBAL"] or [("", 0)])
        end = data.find(b"\n", data.find(b"\n", place) + 1) + 1
        function = chance.choice(FUNCTIONS).replace(" ", "\n").encode()
        return data[:place] + b"c" + function + b"\n" + data[end:]
    if way < 0.75:
        _, place = chance.choice(steps)
        return (
            data[:place]
            + bytes([chance.choice(b"(.0N]}K)tRbaeu\x85\x86\x87sQqrhjX\x88cR")])
            + data[place + 1 :]
        )
    if way < 0.8:  # tuples of tuples, as a key of the dictionary: hashing them takes for ever
        tower = b"K\x01" + b"".join(b"q\xf0h\xf0\x86" for _ in range(chance.choice((12, 40))))
        return data[:2] + b"}" + tower + b"K\x01s."
    if way < 0.85:
        body = b"cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R"
        return (
            data[:2]
            + chance.choice((body, b"c_codecs\nencode\nX\x01\x00\x00\x00aX\x03\x00\x00\x00hex\x86R"))
            + b"."
        )
    return turned(chance, data)


def _packed(chance: random.Random, members: dict[str, bytes]) -> bytes:
    """Return the archive, as PyTorch or as others write it, with checksums that fit."""
    stream = io.BytesIO()
    way = zipfile.ZIP_DEFLATED if chance.random() < 0.1 else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w", way) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
        if chance.random() < 0.003:
            archive.writestr("archive/data/9", bytes(1 << 27), zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def run(count: int, seed: int = 1) -> dict[str, int]:
    """Read `count` altered checkpoints; see `batches.run`."""
    return batches.run("checkpoints", count, seed)


def main(words: list[str]) -> None:
    """Run from the command line; see above."""
    numbers = [int(word) for word in words] or [20_000]
    if len(numbers) == 3:
        read_all(batches.keep("checkpoints", *numbers[1:]))
    else:
        print(json.dumps(run(*numbers)))


if __name__ == "__main__":
    main(sys.argv[1:])
