"""Files that are made to do harm, each by one trick: what fuzzing would not find by itself."""

from __future__ import annotations

import io
import os
import sys
import zipfile
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch

from data.exr_image import read_exr
from models import WSKP
from tests.fuzz import exr
from tests.fuzz.checkpoints import TREE
from trainer.archives import ForeignObject, check_archive
from trainer.building import TRUSTED
from trainer.export import export
from trainer.export.artifact import load_artifact
from trainer.loading import load_model
from trainer.reading import read_checkpoint


def archive(path: Path, pickled: bytes, way: int = zipfile.ZIP_STORED, **records: bytes) -> Path:
    with zipfile.ZipFile(path, "w", way) as file:
        file.writestr("archive/data.pkl", pickled)
        file.writestr("archive/version", b"3\n")
        file.writestr("archive/byteorder", b"little")
        for name, data in records.items():
            file.writestr(f"archive/data/{name[1:]}", data)
    return path


def tensor(count: int, size: int, stride: int = 1) -> bytes:
    """Return the pickle of a dictionary with one tensor."""
    place = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuJ"
    shape = b"J" + size.to_bytes(4, "little") + b"\x85J" + stride.to_bytes(4, "little") + b"\x85"
    storage = place + count.to_bytes(4, "little") + b"tQK\x00"
    function = b"\x80\x02}X\x01\x00\x00\x00actorch._utils\n_rebuild_tensor_v2\n("
    return function + storage + shape + b"\x89ccollections\nOrderedDict\n)RtRs."


def test_a_hand_made_checkpoint_is_read(tmp_path):
    path = archive(tmp_path / "a.ckpt", tensor(4, 4), _0=bytes(16))
    assert torch.equal(read_checkpoint(path)["a"], torch.zeros(4))


@pytest.mark.parametrize(
    ("pickled", "message"),
    [
        (tensor(1 << 28, 1 << 28), "claim other bytes"),
        (tensor(4, 1 << 28), "larger than what is stored"),
        (tensor(4, 1 << 28, 0), "larger than what is stored"),
        (b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R.", r"Python objects .*builtins\.bytearray"),
        (b"\x80\x02ctorch._utils\n_rebuild_sparse_tensor\n.", "Python objects"),
        (b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.", r"os\.system"),
        (b"\x80\x02}K\x01" + b"q\x01h\x01\x86" * 60 + b"K\x01s.", "tuple of too many values"),
        (b"\x80\x02}X\xff\xff\xff\x7fa.", "truncated"),
        (b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".", "holds a list|truncated"),
        (b"", "truncated"),
    ],
)
def test_a_checkpoint_that_claims_more_than_it_holds_is_refused_at_once(tmp_path, pickled, message):
    path = archive(tmp_path / "bad.ckpt", pickled, _0=bytes(16))
    with pytest.raises(ValueError, match=rf"bad\.ckpt .*({message})"):
        read_checkpoint(path)


def test_a_compressed_bomb_is_not_unpacked(tmp_path):
    path = archive(tmp_path / "bomb.ckpt", tensor(1 << 22, 4), zipfile.ZIP_DEFLATED, _0=bytes(1 << 24))
    with pytest.raises(ValueError, match="compressed"):
        read_checkpoint(path)


def test_objects_of_other_libraries_are_named(tmp_path):
    path = archive(tmp_path / "a.ckpt", b"\x80\x02cpathlib\nPosixPath\n.")
    with pytest.raises(ForeignObject, match=r"pathlib\.PosixPath"):
        check_archive(path)


def saved(path: Path, tree: Any, state: dict[str, Any] | None = None) -> str:
    torch.save({"hyper_parameters": {"net": tree}, "state_dict": state or {}}, path)
    return str(path)


@pytest.mark.parametrize("nested", [False, True])
def test_a_checkpoint_cannot_have_a_module_imported(tmp_path, monkeypatch, nested):
    (tmp_path / "lying_there.py").write_text("import pathlib\npathlib.Path('was-here').touch()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    tree: dict[str, Any] = {"class_path": "lying_there.Net", "init_args": {}}
    if nested:
        tree = {"class_path": "models.WSKP", "init_args": {"layers": tree}}
    with pytest.raises(ValueError, match=rf"may not choose what is imported.* {TRUSTED}=lying_there"):
        load_model(saved(tmp_path / "a.ckpt", tree))
    assert not Path("was-here").exists()
    assert "lying_there" not in sys.modules


def test_a_package_that_the_user_trusts_is_imported(tmp_path, monkeypatch):
    text = "from models import JointBilateral\nclass Net(JointBilateral):\n    pass\n"
    (tmp_path / "trusted_networks.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(TRUSTED, "other, trusted_networks")
    path = saved(tmp_path / "a.ckpt", {"class_path": "trusted_networks.Net", "init_args": {}})
    assert type(load_model(path)).__name__ == "Net"
    del sys.modules["trusted_networks"]


@pytest.mark.parametrize(
    "name", ["os.system", "subprocess.Popen", "torch.jit.load", "lightning.pytorch.Trainer"]
)
def test_functions_and_classes_that_are_no_networks_are_never_called(tmp_path, name):
    tree = {"class_path": "models.WSKP", "init_args": {"layers": {"class_path": name, "init_args": {}}}}
    with pytest.raises(ValueError, match="not a network"):
        load_model(saved(tmp_path / "a.ckpt", tree))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 100_000}, "size mismatch"),
        ({"layers": 1_000_000}, "far more weights than are stored"),
        ({"layers": 1 << 40}, "no text or number"),
    ],
)
def test_a_network_that_is_larger_than_its_weights_is_refused_before_it_is_made(tmp_path, changes, message):
    state = {f"net.{n}": v for n, v in WSKP(**TREE["init_args"]).state_dict().items()}  # type: ignore[arg-type]
    tree = {**TREE, "init_args": {**TREE["init_args"], **changes}}
    with pytest.raises(ValueError, match=message):
        load_model(saved(tmp_path / "a.ckpt", tree, state))


def test_hyper_parameters_that_repeat_themselves_without_end_are_refused(tmp_path):
    values: list[Any] = []
    for _ in range(60):
        values = [values, values]
    with pytest.raises(ValueError, match="too many values"):
        load_model(saved(tmp_path / "a.ckpt", {"class_path": "models.WSKP", "init_args": {"layers": values}}))


def test_weights_of_an_onnx_file_in_other_files_are_not_read(tmp_path):
    export(WSKP(layers=2, width=4, kernel_sizes=(3, 5)).eval(), tmp_path / "a.onnx", "onnx")
    model = onnx.load(tmp_path / "a.onnx")
    weight = model.graph.initializer[0]
    entry = weight.external_data.add()
    entry.key, entry.value = "location", "../secret"
    weight.data_location = onnx.TensorProto.EXTERNAL
    (tmp_path / "b.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match=r"b\.onnx has weights in other files"):
        load_artifact(tmp_path / "b.onnx")


def test_operators_of_other_libraries_in_an_onnx_file_are_refused(tmp_path):
    export(WSKP(layers=2, width=4, kernel_sizes=(3, 5)).eval(), tmp_path / "a.onnx", "onnx")
    model = onnx.load(tmp_path / "a.onnx")
    model.graph.node[0].domain = "evil"
    (tmp_path / "b.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ValueError, match="operators of 'evil'"):
        load_artifact(tmp_path / "b.onnx")


class Reads(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.from_file("/etc/hostname", False, 1)


SPELLINGS = ("torch.from_file", "torch .from_file", "torch. from_file", "(torch).from_file",
             'getattr(torch, "from_file")', "torch.save", "ops.other.run", "ops . other.run")  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_torchscript_that_opens_files_is_refused_however_it_says_so(tmp_path, spelling):
    stream = io.BytesIO()
    torch.jit.save(torch.jit.script(Reads()), stream)
    with zipfile.ZipFile(stream) as original, zipfile.ZipFile(tmp_path / "a.ts", "w") as copy:
        for name in original.namelist():
            copy.writestr(name, original.read(name).replace(b"torch.from_file", spelling.encode()))
    with pytest.raises(ValueError, match=r"its code uses (from_file|getattr|save|ops)"):
        load_artifact(tmp_path / "a.ts")


@pytest.mark.parametrize("size", [1 << 15, 262_152])
def test_an_image_whose_header_claims_a_huge_tile_is_refused_before_it_is_made(tmp_path, size):
    tiled = next(f for f in (base[exr.FILE] for base in exr.bases()) if f[5] & 2)
    place = next(entry.place for entry in exr.entries(tiled)[0] if entry.name == "tiles")
    sides = size.to_bytes(4, "little") * 2
    (tmp_path / "a.exr").write_bytes(tiled[:place] + sides + tiled[place + 8 :])
    with pytest.raises(ValueError, match=r"a\.exr: the header claims \d+ MiB of pixels"):
        read_exr(tmp_path / "a.exr")


def test_a_run_record_of_other_types_is_named(tmp_path):
    from trainer.runs import RunRecord

    (tmp_path / "run.json").write_text('{"experiment": 3, "name": "a"}')
    with pytest.raises(ValueError, match=r"run\.json is damaged: experiment is no text"):
        RunRecord.load(tmp_path)
    assert os.listdir(tmp_path) == ["run.json"]
