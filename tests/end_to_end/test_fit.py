"""`trainer fit --config wskp_bmfr.yaml` on the shipped frames, as a newcomer runs it."""

import json

import numpy as np
import pytest
import yaml

from trainer.tracking import open_client


@pytest.fixture(scope="module")
def run(trained):
    record = json.loads((trained.runs[0] / "run.json").read_text())
    client = open_client(record["tracking_uri"])
    return client, client.get_run(record["run_id"])


def artifacts(client, run_id, folder=None):
    found = []
    for entry in client.list_artifacts(run_id, folder):
        found += artifacts(client, run_id, entry.path) if entry.is_dir else [entry.path]
    return found


def test_one_finished_run_with_checkpoints_and_exports(trained):
    assert len(trained.runs) == 1
    for file in ("checkpoints/best.ckpt", "checkpoints/last.ckpt", "export/wskp.onnx", "config.yaml"):
        assert (trained.runs[0] / file).is_file(), file
    assert list((trained.runs[0] / "export").glob("wskp.ts"))
    assert list((trained.runs[0] / "pictures").glob("*.png"))
    assert "Traceback" not in trained.printed
    assert "Warning" not in trained.printed


def test_training_tells_a_health_check_that_it_goes_on(trained):
    assert trained.alive.is_file()


def test_run_says_what_it_was(run):
    _, tracked = run
    assert tracked.info.status == "FINISHED"
    parameters, tags = tracked.data.params, tracked.data.tags
    assert parameters["model.init_args.net.class_path"] == "models.WSKP"
    assert parameters["seed_everything"] == "1"
    assert len(tags["data.manifest_hash"]) >= 16
    assert tags["version.torch"]
    assert float(tags["export.onnx.parity"]) < 1e-4
    assert float(tags["export.torchscript.parity"]) < 1e-4


def test_run_holds_metrics_per_step_epoch_and_scene(run):
    client, tracked = run
    metrics = tracked.data.metrics
    assert len(client.get_metric_history(tracked.info.run_id, "train/loss_step")) == 4
    for name in ("train/loss_epoch", "val/psnr_wskp", "val/ssim_wskp", "val/relmse_layer", "val/smape_wskp"):
        assert np.isfinite(metrics[name]), name
    assert any(name.startswith("val/psnr_wskp/") for name in metrics)
    assert 0 <= metrics["throughput/waiting"] <= 1


def test_run_holds_configuration_packages_pictures_and_files(run):
    client, tracked = run
    names = artifacts(client, tracked.info.run_id)
    assert {"config.yaml", "packages.txt", "checkpoints/best.ckpt", "export/wskp.onnx"} <= set(names)
    assert any(name.endswith(".png") and "validation" in name for name in names)


@pytest.mark.slow
def test_recorded_configuration_trains_again(trained, workplace):
    config = yaml.safe_load((trained.runs[0] / "config.yaml").read_text())
    assert config["model"]["init_args"]["net"]["init_args"]["layers"] == 6
    again = workplace.folder / "again.yaml"
    again.write_text((trained.runs[0] / "config.yaml").read_text())
    workplace.trainer("fit", "--config", str(again))
    first, second = (weights(place.runs[0] / "checkpoints" / "last.ckpt") for place in (trained, workplace))
    assert all((first[name] == second[name]).all() for name in first)


@pytest.mark.filterwarnings("ignore:.*Any type hint is inferred")  # MLflow's own, while it is imported
def test_registered_model_runs_through_pyfunc(trained):
    import mlflow

    from trainer.export.register import using_store

    with using_store(f"sqlite:///{trained.folder / 'runs' / 'mlflow.db'}"):
        model = mlflow.pyfunc.load_model("models:/wskp/1")
    assert model.metadata.signature is not None
    shapes = {"irradiance": 3, "albedo": 3, "normal": 3, "depth": 1}
    inputs = {name: np.ones((1, channels, 20, 31), np.float32) for name, channels in shapes.items()}
    inputs["exposure"] = np.ones(1, np.float32)  # MLflow has no optional inputs
    color = model.predict(inputs)["color"]
    assert color.shape == (1, 3, 20, 31)
    assert np.allclose(color, 1, atol=1e-5)


def test_test_command_prints_metrics_per_scene_and_joins_the_run(trained, run):
    client, tracked = run
    printed = trained.trainer("test", "--config", "wskp_bmfr.yaml", "--config", "smoke.yaml")
    assert "classroom" in printed
    assert all(name in printed for name in ("psnr_wskp", "ssim_wskp", "relmse_layer", "smape_wskp"))
    assert "test/psnr_wskp" in client.get_run(tracked.info.run_id).data.metrics
    assert len(trained.runs) == 1


def test_denoise_with_the_trained_checkpoint_writes_frames_and_pictures(trained):
    output = trained.folder / "denoised"
    trained.trainer(
        "denoise", "--model", str(trained.runs[0] / "checkpoints" / "best.ckpt"), "sample:bmfr", "--split",
        "test", "--output", str(output), "--png",
    )  # fmt: skip
    assert len(list(output.rglob("*.exr"))) >= 8
    assert len(list(output.rglob("*.png"))) >= 8


def test_checkpoint_of_another_model_is_refused(trained):
    printed = trained.trainer(
        "test", "--config", "wskp_bmfr.yaml", "--model.init_args.net.init_args.layers", "3", code=1
    )
    assert "layers=6" in printed
    assert "layers=3" in printed
    assert "Traceback" not in printed


def test_last_without_a_run_is_an_error_that_says_where_it_looked(workplace):
    printed = workplace.trainer("fit", "--config", "wskp_bmfr.yaml", "--ckpt_path", "last", code=1)
    assert "no run of 'wskp_bmfr' below" in printed


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--trainer.precision=bf16-mixed", "--trainer.gradient_clip_val=0.5"])
def test_precision_and_clipping_are_options(workplace, option):
    workplace.trainer("fit", "--config", "wskp_bmfr.yaml", "--config", "smoke.yaml", option)
    assert np.isfinite(float(open_metrics(workplace)["train/loss_epoch"]))


@pytest.mark.slow
def test_averaged_weights_are_an_option(workplace):
    workplace.trainer(
        "fit", "--config", "wskp_bmfr.yaml", "--config", "smoke.yaml",
        "--trainer.callbacks+=lightning.pytorch.callbacks.EMAWeightAveraging",
        "--trainer.callbacks.init_args.decay=0.9",
    )  # fmt: skip
    import torch

    checkpoint = torch.load(workplace.runs[0] / "checkpoints" / "best.ckpt", weights_only=True)
    averaged, current = checkpoint["state_dict"], checkpoint["current_model_state"]
    assert any((averaged[name] != current[name]).any() for name in current)


def open_metrics(place):
    record = json.loads((place.runs[0] / "run.json").read_text())
    return open_client(record["tracking_uri"]).get_run(record["run_id"]).data.metrics


def weights(path):
    import torch

    return torch.load(path, weights_only=True)["state_dict"]
