"""Two processes train as one does on the same global batches."""

import pytest
import torch

OPTIONS = (
    "--config", "wskp_bmfr.yaml", "--trainer.max_epochs", "1", "--trainer.limit_train_batches", "5",
    "--trainer.limit_val_batches", "2", "--data.init_args.augment", "false",
    "--data.init_args.batch_size", "2", "--data.init_args.train_patches", "80",
    "--model.init_args.lr_scheduler", "null", "--trainer.gradient_clip_val", "null",
    # Adam divides by the size of the gradient, which turns rounding of one near zero into a step.
    "--model.init_args.optimizer", "torch.optim.SGD", "--model.init_args.optimizer.init_args.lr", "0.1",
)  # fmt: skip


def one_process(config_net, batches):
    """Train on given global batches with the same initial weights; returns the state of the network."""
    from lightning.pytorch import seed_everything

    from models import WSKP
    from models.denoiser import select
    from trainer.losses import SMAPE

    seed_everything(1)
    net = WSKP(**config_net)
    optimizer = torch.optim.SGD(net.parameters(), lr=0.1)
    for batch in batches:
        exposure = batch["exposure"].reshape(-1, 1, 1, 1)
        loss = SMAPE()(net(select(net, batch)).color * exposure, batch["reference"] * exposure)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return net.state_dict()


def global_batches(cache, steps):
    """Return the batches of both ranks of the first epoch, joined."""
    import os

    from data import Shards

    os.environ["PENUMBRA_CACHE"] = str(cache)
    try:
        loaders = []
        for rank in range(2):
            module = Shards(batch_size=2, workers=0, augment=False, train_patches=80)
            module.prepare_data()
            loader = module.train_dataloader()
            loader.rank, loader.world = rank, 2
            loaders.append(iter(loader))
        for _ in range(steps):
            parts = [next(loader) for loader in loaders]
            tensors = [key for key, value in parts[0].items() if isinstance(value, torch.Tensor)]
            yield {key: torch.cat([part[key] for part in parts]) for key in tensors}
    finally:
        del os.environ["PENUMBRA_CACHE"]


def test_two_gloo_processes_end_with_the_weights_of_one(workplace, cache):
    workplace.trainer(
        "fit", *OPTIONS, "--trainer.accelerator", "cpu", "--trainer.devices", "2", "--trainer.strategy", "ddp"
    )
    assert len(workplace.runs) == 1
    checkpoint = torch.load(workplace.runs[0] / "checkpoints" / "last.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 5
    expected = one_process({"layers": 6}, global_batches(cache, 5))
    for name, tensor in expected.items():
        found = checkpoint["state_dict"][f"net.{name}"]
        assert torch.allclose(found, tensor, rtol=1e-4, atol=1e-5), name


@pytest.mark.slow
@pytest.mark.parametrize("candidates", [160, 80], ids=["three", "fewer than ranks"])
def test_two_ranks_validate_few_samples_with_a_network_that_has_buffers(workplace, candidates):
    """Ranks have different numbers of batches, one of them perhaps none, and neither waits for the other."""
    common = (
        "--config", "wskp_bmfr.yaml", "--model.init_args.net", "tests.end_to_end.normalised.Normalised",
        "--data.init_args.root", "sample:stills", "--data.init_args.recipe", "afgsa",
        "--data.init_args.train_patches", str(candidates), "--data.init_args.patch_size", "64",
        "--data.init_args.batch_size", "1", "--trainer.accelerator", "cpu",
    )  # fmt: skip
    best = "{class_path: trainer.callbacks.BestCheckpoint, init_args: {monitor: val/loss, mode: min}}"
    two = ("--trainer.devices", "2", "--trainer.strategy", "ddp")
    workplace.trainer("fit", *common, *two, "--trainer.max_epochs", "2", "--trainer.limit_train_batches",
                      "2", "--trainer.callbacks", f"[{best}]")  # fmt: skip
    shared = scores(workplace.trainer("validate", *common, *two))
    alone = scores(workplace.trainer("validate", *common))
    assert shared == alone != []


def scores(printed):
    """Return the rows of the table of scores."""
    return [line for line in printed.splitlines() if "indoor" in line or "outdoor" in line]
