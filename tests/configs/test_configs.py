"""Every shipped configuration parses, is instantiated and trains for one step."""

import json
import os
import subprocess
import sys

import pytest
import yaml

from trainer import configs
from trainer.ablation.plan import find_ablation, read_ablation
from trainer.ablation.variants import trainings_of

ABLATIONS = sorted(path.name for path in (configs.folder() / configs.ABLATIONS).glob("*.yaml"))
SMOKE = "smoke.yaml"
OVERLAYS = {f"{name}_sample.yaml": f"{name}_tungsten.yaml" for name in ("acfm", "afgsa", "kpcn")}
OVERLAYS |= {
    f"{name}_sample.yaml": f"{name}_random.yaml" for name in ("layers", "pixelgather", "samplesplat", "sbmc")
}
OVERLAYS["layers_optimized_sample.yaml"] = "layers_optimized.yaml"
OVERLAYS |= {"kp1_bmfr.yaml": "kp_bmfr.yaml", "kp2_bmfr.yaml": "kp_bmfr.yaml"}
OVERLAYS["mrkp_meng.yaml"] = "mrkp_bmfr.yaml"
OVERLAYS["lbf_sample.yaml"] = "lbf_stills.yaml"
"""Overlay → what it is laid over."""

NARROW = {
    "acfm_tungsten.yaml": {"net.init_args": {"blocks": 1, "width": 8, "condition_width": 8, "condition": 4}},
    "afgsa_tungsten.yaml": {"net.init_args": {"blocks": 1, "width": 16}},
    "kpcn_tungsten.yaml": {"net.init_args": {"layers": 2, "width": 4}},
    "lbf_stills.yaml": {"net.init_args": {"features": "[normal]", "window": 3}},
    **{
        f"{name}.yaml": {"net.init_args": {"width": 4, "kernel_size": 5}}
        for name in (
            *("layers_random", "pixelgather_random", "samplesplat_random", "layers_optimized"),
            "sbmc_random",
        )
    },
}
"""Networks whose published size would take a minute for a step, or that read what no sample
holds; their tests build them in that size."""
for name in ("acfm_tungsten.yaml", "afgsa_tungsten.yaml"):
    NARROW[name]["critic.init_args"] = {"width": 4, "norm": "none"}

RUN = """
import json, sys, traceback
from trainer.cli import main
codes = {}
for name, arguments in json.loads(sys.argv[1]).items():
    try:
        sys.argv = ["trainer", *arguments]
        codes[name] = main()
    except BaseException:
        traceback.print_exc()
        codes[name] = "raised"
print(json.dumps(codes))
"""


def arguments(name):
    """What trains a configuration for one step, an overlay with what it is laid over."""
    files = [OVERLAYS[name], name] if name in OVERLAYS else [name]
    options = {
        "trainer.limit_train_batches": 1,
        "data.init_args.batch_size": 1,
        "data.init_args.workers": 0,
        "data.init_args.train_patches": 80,
        "trainer.max_steps": -1,
        "trainer.check_val_every_n_epoch": 1,
        "trainer.logger.init_args.experiment": name.removesuffix(".yaml"),
    }
    if name in NARROW or name in OVERLAYS:  # exports of every network have tests of their own
        options["trainer.callbacks"] = "[{class_path: trainer.callbacks.BestCheckpoint}]"
    for part, values in NARROW.get(name, {}).items():
        options |= {f"model.init_args.{part}.{key}": value for key, value in values.items()}
    layers = [part for file in (*files, SMOKE) for part in ("--config", file)]
    return ["fit", *layers, *(part for key, value in options.items() for part in (f"--{key}", str(value)))]


TRAINED = [name for name in configs.names() if name != SMOKE]


def train(folder, commands):
    """Exit code of each training, all by one process, and what it printed."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MLFLOW_", "PENUMBRA_"))}
    environment |= {"OMP_NUM_THREADS": "2", "PENUMBRA_CACHE": str(folder / "cache")}
    command = [sys.executable, "-c", RUN, json.dumps(commands)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Exit code of each configuration, the folder, and what was printed."""
    folder = tmp_path_factory.mktemp("configs")
    codes, printed = train(folder, {name: arguments(name) for name in TRAINED})
    return codes, folder, printed


def test_defaults_and_overlays_are_there():
    assert (configs.folder() / configs.DEFAULTS).is_file()
    assert set(configs.names()) >= {SMOKE, *OVERLAYS, *OVERLAYS.values()}


@pytest.mark.parametrize("name", configs.names())
def test_configuration_has_a_header_and_stays_short(name):
    text = (configs.folder() / name).read_text()
    assert text.startswith("# ")
    assert text.count("\n") <= 60
    assert isinstance(yaml.safe_load(text), dict)


@pytest.mark.parametrize("name", TRAINED)
def test_configuration_trains_for_one_step(name, trained):
    codes, folder, printed = trained
    assert codes[name] == 0, printed
    run = folder / "runs" / name.removesuffix(".yaml")
    assert list(run.glob("*/checkpoints/best.ckpt"))


@pytest.mark.parametrize(("overlay", "base"), OVERLAYS.items())
def test_an_overlay_keeps_method_and_data_of_what_it_is_laid_over(overlay, base):
    over, under = (yaml.safe_load((configs.folder() / name).read_text()) for name in (overlay, base))
    assert over["model"]["class_path"] == under["model"]["class_path"]
    networks = [file["model"]["init_args"]["net"]["class_path"] for file in (over, under)]
    assert networks[0] == networks[1]
    assert under["data"]["init_args"]["root"] in ("sample:bmfr", "sample:stills", "sample:layers")
    assert "root" not in over.get("data", {}).get("init_args", {})


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_variant_of_an_ablation_is_a_configuration_of_its_own(name):
    ablation = read_ablation(find_ablation(f"{configs.ABLATIONS}/{name}"))
    trainings = trainings_of(ablation, ())
    assert [training.variant for training in trainings] == list(ablation.variants)
    assert {training.data for training in trainings} == {"sample:bmfr"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ABLATIONS)
def test_every_variant_of_an_ablation_trains_for_one_step(name, tmp_path):
    ablation = read_ablation(find_ablation(f"{configs.ABLATIONS}/{name}"))
    options = {"batch_size": 1, "workers": 0, "train_patches": 80}
    words = [f"--data.init_args.{key}={value}" for key, value in options.items()]
    trainings = trainings_of(ablation, ["--config", SMOKE, "--trainer.limit_train_batches=1", *words])
    commands = {training.variant.name: ["fit", *training.command({"a": "b"})] for training in trainings}
    codes, printed = train(tmp_path, commands)
    assert set(codes.values()) == {0}, printed
    assert len(list((tmp_path / "runs" / ablation.name).glob("*/checkpoints/best.ckpt"))) == len(trainings)
