"""Every shipped configuration parses, is instantiated and trains for one step."""

import os
import subprocess
import sys

import pytest
import yaml

from trainer import configs

OVERLAYS = {"smoke.yaml"}


def test_defaults_and_overlays_are_there():
    assert (configs.folder() / configs.DEFAULTS).is_file()
    assert set(configs.names()) >= OVERLAYS


@pytest.mark.parametrize("name", configs.names())
def test_configuration_has_a_header_and_stays_short(name):
    text = (configs.folder() / name).read_text()
    assert text.startswith("# ")
    assert text.count("\n") <= 60
    assert isinstance(yaml.safe_load(text), dict)


@pytest.mark.parametrize("name", [n for n in configs.names() if n not in OVERLAYS])
def test_configuration_trains_for_one_step(name, tmp_path):
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "PENUMBRA_"))}
    environment |= {"OMP_NUM_THREADS": "2", "PENUMBRA_CACHE": str(tmp_path / "cache")}
    command = [
        sys.executable, "-m", "trainer", "fit", "--config", name, "--config", "smoke.yaml",
        "--trainer.limit_train_batches", "1", "--data.init_args.batch_size", "1",
        "--data.init_args.workers", "0", "--data.init_args.train_patches", "80",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob("runs/*/*/checkpoints/last.ckpt"))
