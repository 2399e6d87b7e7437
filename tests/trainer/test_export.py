"""Exported files: they agree with eager, take any size, and carry what others need to know."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

import models
from models import WSKP
from models.denoiser import Buffers, Denoised, Denoiser
from tests.conformance.test_denoisers import make
from trainer.commands import export as command
from trainer.export import SUFFIXES, Source, export, load_artifact, parity
from trainer.export.artifact import _OnnxRuntime
from trainer.export.description import KEY, Description
from trainer.export.entry import Sampled, example
from trainer.export.onnx import OPSET
from trainer.export.parity import LIMIT, relative_error

FORMATS = ("onnx", "torchscript")


def small_wskp(seed: int = 0) -> WSKP:
    torch.manual_seed(seed)
    return WSKP(layers=2, width=6, kernel_sizes=(3, 5, 7)).eval()


class Blur(Denoiser):
    """A plain 3x3 mean without frame numbers."""

    inputs = ("color",)
    halo = 1

    def forward(self, buffers: Buffers) -> Denoised:
        self.check(buffers)
        return Denoised(nn.functional.avg_pool2d(buffers["color"], 3, 1, 1, count_include_pad=False))


class Baked(Blur):
    """Breaks tracing: the height becomes a constant of the graph."""

    def forward(self, buffers: Buffers) -> Denoised:
        color = buffers["color"]
        rows = torch.linspace(0, 1, int(color.shape[-2]))
        return Denoised(color * rows.mean() + rows.new_tensor(float(color.shape[-2])))


class Rounded(Blur):
    """Loses digits, other ones where it is traced."""

    def __init__(self, eager: float, traced: float) -> None:
        super().__init__()
        self.eager, self.traced = eager, traced

    def forward(self, buffers: Buffers) -> Denoised:
        large = self.traced if torch.jit.is_tracing() else self.eager
        return Denoised((super().forward(buffers).color + large) - large)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("export")
    paths = {format: folder / f"net{SUFFIXES[format]}" for format in FORMATS}
    for format, path in paths.items():
        source = Source("made.ckpt", "models.WSKP", {"layers": 2, "width": 6}, sha256="ab", step=9)
        export(small_wskp(), path, format, source=source)  # type: ignore[arg-type]
    return paths


def buffers_of(net: Denoiser, batch: int, height: int, width: int, seed: int = 5) -> dict[str, Tensor]:
    return example(net.inputs, batch, height, width, seed, Sampled(net.samples, 3))


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("size", [(1, 16, 16), (2, 33, 47), (3, 61, 18)])
def test_an_artifact_agrees_with_eager_at_odd_sizes_and_batches(
    files: dict[str, Path], format: str, size: tuple[int, int, int]
) -> None:
    net = small_wskp()
    buffers = buffers_of(net, *size)
    with torch.inference_mode():
        expected = net(buffers).color
    found = load_artifact(files[format])(buffers).color
    assert relative_error(found, expected) < LIMIT


@pytest.mark.parametrize("format", FORMATS)
def test_frame_numbers_are_optional_and_the_depth_range_is_then_measured(
    files: dict[str, Path], format: str
) -> None:
    net, artifact = small_wskp(), load_artifact(files[format])
    plain = buffers_of(net, 2, 20, 30)
    numbers = {"exposure": torch.ones(2), "depth_range": net.measure(plain)["depth_range"]}
    assert torch.equal(artifact(plain).color, artifact({**plain, **numbers}).color)


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("number", ["exposure", "depth_range"])
def test_a_given_frame_number_changes_the_result_as_in_eager(
    files: dict[str, Path], format: str, number: str
) -> None:
    net, artifact = small_wskp(), load_artifact(files[format])
    plain = buffers_of(net, 2, 20, 30)
    value = {"exposure": torch.tensor([0.01, 0.1]), "depth_range": torch.tensor([[0.0, 90.0], [0.0, 400.0]])}
    given = {**plain, number: value[number]}
    with torch.inference_mode():
        expected = net(given).color
    found = artifact(given).color
    assert relative_error(found, expected) < LIMIT
    assert not torch.equal(found, artifact(plain).color)


def test_onnx_runtime_needs_only_the_buffers_and_names_the_output_color(files: dict[str, Path]) -> None:
    session = onnxruntime.InferenceSession(files["onnx"], providers=["CPUExecutionProvider"])
    assert [i.name for i in session.get_inputs()] == ["irradiance", "albedo", "normal", "depth"]
    assert [i.name for i in session.get_overridable_initializers()] == ["exposure", "depth_range"]
    assert [o.name for o in session.get_outputs()] == ["color"]
    assert session.get_inputs()[3].shape == ["batch", 1, "height", "width"]


def test_the_onnx_file_is_valid_and_has_the_documented_operator_set(files: dict[str, Path]) -> None:
    model = onnx.load(files["onnx"])
    onnx.checker.check_model(model, full_check=True)
    assert model.opset_import[0].version == OPSET


def test_torchscript_runs_without_penumbra_from_the_mapping(files: dict[str, Path]) -> None:
    module = torch.jit.load(str(files["torchscript"]))
    net = small_wskp()
    buffers = buffers_of(net, 1, 19, 23)
    with torch.inference_mode():
        assert relative_error(module(buffers), net(buffers).color) < LIMIT
    with pytest.raises(torch.jit.Error, match="missing buffer irradiance"):
        module({"albedo": buffers["albedo"]})


@pytest.mark.parametrize("format", FORMATS)
def test_metadata_holds_contract_source_and_parity(files: dict[str, Path], format: str) -> None:
    net, artifact = small_wskp(), load_artifact(files[format])
    said = artifact.description
    assert (said.model, said.format, said.inputs) == ("WSKP", format, net.inputs)
    assert said.frame_numbers == ("exposure", "depth_range")
    assert (artifact.halo, artifact.multiple, artifact.temporal) == (net.halo, 1, True)
    assert said.source == Source("made.ckpt", "models.WSKP", {"layers": 2, "width": 6}, "ab", 9)
    assert said.parity is not None
    assert 0 <= said.parity.error <= said.parity.limit == LIMIT
    assert sum(h % 2 or w % 2 for _, h, w in said.parity.sizes) >= 3
    assert said.versions["torch"] == torch.__version__


def test_metadata_can_be_read_without_penumbra(files: dict[str, Path]) -> None:
    in_onnx = {p.key: p.value for p in onnx.load(files["onnx"]).metadata_props}
    with zipfile.ZipFile(files["torchscript"]) as archive:
        name = next(n for n in archive.namelist() if n.endswith("extra/penumbra.json"))
        in_torchscript = json.loads(archive.read(name))
    assert json.loads(in_onnx[KEY])["inputs"] == in_torchscript["inputs"]


def test_the_artifact_measures_what_the_denoiser_measures(files: dict[str, Path]) -> None:
    net, artifact = small_wskp(), load_artifact(files["onnx"])
    buffers = buffers_of(net, 2, 20, 30)
    assert torch.equal(artifact.measure(buffers)["depth_range"], net.measure(buffers)["depth_range"])


@pytest.mark.parametrize("format", FORMATS)
def test_a_denoiser_without_frame_numbers_or_parameters_is_exported(tmp_path: Path, format: str) -> None:
    path = tmp_path / f"blur{SUFFIXES[format]}"
    export(Blur(), path, format)  # type: ignore[arg-type]
    color = torch.rand(2, 3, 21, 34)
    assert torch.allclose(load_artifact(path)({"color": color}).color, Blur()({"color": color}).color)


UNROLLED = {"LBF", "NFOR", "NLM", "JointNLM", "MultiScaleNLM", "RDFC", "RHF"}
"""Methods whose graph would be hundreds of copies of the same operations."""


@pytest.mark.parametrize("name", sorted(UNROLLED))
def test_methods_of_hundreds_of_offsets_are_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} cannot be exported: it visits hundreds of window offsets"):
        export(make(name), tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


SOLVED = {"WLR"}
"""Methods that need an operation that ONNX does not have."""


@pytest.mark.parametrize("name", sorted(SOLVED))
def test_methods_with_eigenvectors_are_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} cannot be exported: it needs the eigenvectors"):
        export(make(name), tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


FILTERS = {"BMFR", "SVGF"}
"""Methods that look anywhere in the frame before."""


@pytest.mark.parametrize("name", sorted(FILTERS))
def test_filters_of_sequences_are_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} cannot be exported: each of its frames needs the state"):
        export(make(name), tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", FORMATS)
def test_a_filter_made_of_slices_is_exported_without_a_warning(tmp_path: Path, format: str) -> None:
    net = models.JointBilateral(radius=2)
    assert export(net, tmp_path / "net.bin", format).error <= LIMIT  # type: ignore[arg-type]


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(
    "name", sorted(set(models.__all__) - {"WSKP", "JointBilateral"} - UNROLLED - SOLVED - FILTERS)
)
def test_every_network_is_exported_and_takes_any_size(tmp_path: Path, name: str, format: str) -> None:
    torch.manual_seed(3)
    net = make(name)
    path = tmp_path / f"net{SUFFIXES[format]}"
    export(net, path, format)  # type: ignore[arg-type]
    artifact = load_artifact(path)
    for size in ((2, 37, 29), (1, 16, 50)):
        buffers = buffers_of(net, *size)
        with torch.inference_mode():
            expected = net(buffers).color
            assert parity.agreement(net, buffers, artifact(buffers).color, expected)[1] is not None


def test_export_leaves_the_denoiser_as_it_was(tmp_path: Path) -> None:
    net = small_wskp().train()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    export(net, tmp_path / "net.onnx")
    assert net.training
    assert all(parameter.requires_grad for parameter in net.parameters())
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


@pytest.mark.parametrize("format", FORMATS)
def test_failing_parity_leaves_nothing_behind_and_says_where(tmp_path: Path, format: str) -> None:
    with pytest.raises(
        ValueError, match=r"Baked cannot be exported as .*: the exported file .* at batch 1, 31x17"
    ):
        export(Baked(), tmp_path / "out" / "net.bin", format)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_an_existing_file_is_kept_unless_forced(tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    path.write_text("precious")
    with pytest.raises(ValueError, match="--force"):
        export(Blur(), path)
    assert path.read_text() == "precious"
    export(Blur(), path, force=True)
    assert load_artifact(path).inputs == ("color",)
    assert [p.name for p in tmp_path.iterdir()] == ["net.onnx"]


def test_an_unknown_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="known: onnx, torchscript"):
        export(Blur(), tmp_path / "net.tza", "tza")  # type: ignore[arg-type]


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("keep", [0.5, 0.98])
def test_a_truncated_artifact_is_an_error_that_names_it(
    files: dict[str, Path], tmp_path: Path, format: str, keep: float
) -> None:
    content = files[format].read_bytes()
    path = tmp_path / files[format].name
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(ValueError, match=path.name):
        load_artifact(path)


def test_a_foreign_onnx_file_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    model = onnx.load(files["onnx"])
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "foreign.onnx")
    with pytest.raises(ValueError, match="not exported by Penumbra"):
        load_artifact(tmp_path / "foreign.onnx")


def test_a_foreign_torchscript_file_is_refused(tmp_path: Path) -> None:
    torch.jit.script(nn.Conv2d(3, 3, 1)).save(str(tmp_path / "foreign.ts"))
    with pytest.raises(ValueError, match="not exported by Penumbra"):
        load_artifact(tmp_path / "foreign.ts")


def test_metadata_of_a_later_version_is_refused() -> None:
    with pytest.raises(ValueError, match="known up to 3; update penumbra-denoise"):
        Description.from_json(json.dumps({"version": 99}))


def test_an_artifact_names_missing_and_misshapen_buffers(files: dict[str, Path]) -> None:
    artifact = load_artifact(files["onnx"])
    buffers = buffers_of(small_wskp(), 1, 20, 30)
    with pytest.raises(ValueError, match="missing: depth"):
        artifact({name: value for name, value in buffers.items() if name != "depth"})
    with pytest.raises(ValueError, match=r"'albedo' has shape \(1, 1, 20, 30\)"):
        artifact({**buffers, "albedo": buffers["depth"]})


def test_relative_error_sees_a_single_wrong_pixel_and_nan() -> None:
    expected = torch.ones(1, 3, 8, 8)
    wrong = expected.clone()
    wrong[0, 1, 3, 4] = 1.01
    assert relative_error(wrong, expected) == pytest.approx(0.01 / 1.01, rel=1e-3)
    wrong[0, 0, 0, 0] = np.nan
    assert relative_error(wrong, expected) == float("inf")


def test_outputs_get_the_models_name_in_a_folder_and_the_suffix_must_fit(tmp_path: Path) -> None:
    both = command.targets(tmp_path, ["onnx", "torchscript"], "wskp")
    assert both == {"onnx": tmp_path / "wskp.onnx", "torchscript": tmp_path / "wskp.ts"}
    assert command.targets(tmp_path / "a.pt", ["torchscript"], "x") == {"torchscript": tmp_path / "a.pt"}
    with pytest.raises(ValueError, match="belongs to onnx"):
        command.targets(tmp_path / "a.onnx", ["torchscript"], "x")
    with pytest.raises(ValueError, match="give a folder"):
        command.targets(tmp_path / "a.onnx", ["onnx", "torchscript"], "x")


def test_a_file_as_exact_as_eager_is_written_although_both_round_by_more_than_the_limit(
    tmp_path: Path,
) -> None:
    parity = export(Rounded(400.0, 200.0), tmp_path / "net.ts", "torchscript")
    assert parity.error > LIMIT
    assert LIMIT / 3 < parity.rounding < 1e-2
    assert load_artifact(tmp_path / "net.ts").description.parity == parity


@pytest.mark.parametrize(("eager", "traced"), [(0.0, 400.0), (20.0, 400.0), (1e5, 5e4)])
def test_a_file_less_exact_than_eager_or_of_no_use_is_refused(
    tmp_path: Path, eager: float, traced: float
) -> None:
    with pytest.raises(ValueError, match="the exported file differs by"):
        export(Rounded(eager, traced), tmp_path / "net.ts", "torchscript")
    assert not (tmp_path / "net.ts").exists()


def test_a_failure_of_onnx_runtime_is_told_in_one_line():
    shape = onnx.numpy_helper.from_array(np.array([7, 2]), "shape")
    node = onnx.helper.make_node("Reshape", ["color", "shape"], ["out"])
    sides = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, None) for n in ("color", "out")]
    graph = onnx.helper.make_graph([node], "graph", sides[:1], sides[1:], [shape])
    opset = [onnx.helper.make_opsetid("", 18)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=9)
    runtime = _OnnxRuntime(model.SerializeToString(), "cpu")
    with pytest.raises(OSError, match=r"ONNX Runtime cannot run the model .*Reshape"):
        runtime({"color": torch.zeros(1, 3, 4, 4)})


def test_rounding_excuses_an_artifact_only_around_the_pixels_where_eager_rounds() -> None:
    exact = torch.ones(1, 3, 20, 20, dtype=torch.float64)
    exact[..., 5, 5] = 1000.0
    eager = exact.clone()
    eager[..., 5, 5] += 5e-4  # 5e-7 of the pixel, 5e-4 of those around
    near, far, bad = exact.clone(), exact.clone(), exact.clone()
    near[:, 0, 6, 8] += 8e-4
    far[:, 0, 15, 15] += 8e-4
    bad[:, 0, 6, 8] += 1.2e-3
    assert parity._as_exact(near, eager, exact, 4) == pytest.approx(5e-7, rel=1e-2)
    assert parity._as_exact(far, eager, exact, 4) is None
    assert parity._as_exact(bad, eager, exact, 4) is None
