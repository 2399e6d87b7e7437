"""The built wheel in an empty environment trains, from another directory."""

import os
import subprocess
import sys
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)],
        check=True, capture_output=True,
    )  # fmt: skip
    return next(folder.glob("penumbra_denoise-*.whl"))


def test_wheel_holds_packages_configurations_and_the_sample_only(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"data", "models", "trainer"}
    assert "trainer/configs/wskp_bmfr.yaml" in names
    assert "trainer/configs/defaults.yaml" in names
    assert {f"trainer/configs/ablations/wskp_{name}.yaml" for name in ("branches", "kernels")} <= set(names)
    assert "data/sample/bmfr/manifest.json" in names
    assert sum(name.endswith(".exr") for name in names) >= 3 * 6
    assert {f"data/sample/{name}/manifest.json" for name in ("stills", "layers")} <= set(names)
    assert "trainer/reports/data_report.html.j2" in names
    assert wheel.stat().st_size < 42e6


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_installed_wheel_trains_in_an_empty_environment_from_another_directory(wheel, tmp_path):
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= {"PENUMBRA_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "2"}

    def run(*command):
        done = subprocess.run(
            command, cwd=tmp_path / "elsewhere", env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout + done.stderr

    (tmp_path / "elsewhere").mkdir()
    constraints = ("--constraint", str(ROOT / "constraints.txt"))
    # The build that runs this test: a plain "torch" would fetch a CUDA build of several gigabytes.
    build = f"torch=={metadata.version('torch')}"
    run(python, "-m", "pip", "install", "--quiet", *constraints, build, str(wheel))
    run(
        str(tmp_path / "env" / "bin" / "trainer"),
        "fit",
        "--config",
        "wskp_bmfr.yaml",
        "--config",
        "smoke.yaml",
    )
    assert list((tmp_path / "elsewhere" / "runs").glob("wskp_bmfr/*/export/wskp.onnx"))
    location = run(python, "-c", "import models; print(models.__file__)").strip()
    assert location.startswith(str(tmp_path / "env"))
