"""The arithmetic of adversarial training: penalty, order, steps, accumulation, schedules, frozen groups."""

import math
from functools import partial

import pytest
import torch

from tests.synthetic import Patches
from tests.trainer.stand_ins import LogNet, SmoothCritic, SplitNet, fit, module
from trainer.modules import adversarial
from trainer.modules.penalty import gradient_penalty, mixing
from trainer.modules.updates import turn
from trainer.schedules import Halving

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval"),
]


def batches(count, size):
    loader = torch.utils.data.DataLoader(Patches(count, 100), size)
    return list(loader)


def test_penalty_of_a_linear_critic_is_the_squared_distance_of_its_slope_from_one():
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(12, dtype=torch.float64, generator=generator, requires_grad=True)
    real, fake = torch.rand(2, 4, 3, 2, 2, dtype=torch.float64, generator=generator)
    penalty = gradient_penalty(lambda x: x.flatten(1) @ weights, real, fake, torch.full((4, 1, 1, 1), 0.3))
    norm = weights.detach().norm()
    assert float(penalty.detach()) == pytest.approx(float((norm - 1) ** 2), rel=1e-9)
    penalty.backward()
    assert torch.allclose(weights.grad, 2 * (norm - 1) * weights.detach() / norm, rtol=1e-9)


def test_penalty_is_taken_between_fake_and_real_for_each_sample():
    real = torch.tensor([1.0, 5.0]).reshape(2, 1, 1, 1)
    fake = torch.tensor([3.0, 9.0]).reshape(2, 1, 1, 1).requires_grad_()
    mix = torch.tensor([0.25, 1.0]).reshape(2, 1, 1, 1)
    # D(x) = x^2 / 2 has the slope x: 0.25 * 3 + 0.75 * 1 = 1.5, and 9.
    penalty = gradient_penalty(lambda x: 0.5 * x.square().sum((1, 2, 3)), real, fake, mix)
    assert float(penalty.detach()) == pytest.approx((0.5**2 + 8.0**2) / 2)
    assert not torch.autograd.grad(penalty, fake, allow_unused=True, materialize_grads=True)[0].any()


def test_penalty_of_a_flat_critic_is_one_with_a_finite_gradient():
    weight = torch.zeros(3, requires_grad=True)
    image = torch.rand(2, 3, 1, 1)
    penalty = gradient_penalty(lambda x: x.flatten(1) @ weight, image, image, torch.rand(2, 1, 1, 1))
    penalty.backward()
    assert float(penalty.detach()) == pytest.approx(1, abs=1e-5)
    assert torch.isfinite(weight.grad).all()


def test_mixing_follows_from_its_key_alone_and_differs_between_keys():
    like = torch.zeros(1000, 3, 2, 2)
    first = mixing((1, 0, 5, 0), like)
    assert first.shape == (1000, 1, 1, 1)
    assert torch.equal(first, mixing((1, 0, 5, 0), like))
    assert 0 <= float(first.min()) < 0.01 < 0.99 < float(first.max()) < 1
    for other in ((2, 0, 5, 0), (1, 1, 5, 0), (1, 0, 6, 0), (1, 0, 5, 1)):
        assert not torch.equal(first, mixing(other, like))


def test_mixing_of_the_ranks_is_that_of_one_process_on_the_joint_batch():
    joint = mixing((1, 0, 5, 0), torch.zeros(12, 3, 2, 2))
    parts = [mixing((1, 0, 5, 0), torch.zeros(4, 3, 2, 2), rank) for rank in range(3)]
    assert torch.equal(torch.cat(parts), joint)


@pytest.mark.parametrize("count", [1, 5, 6, 7, 12])
@pytest.mark.parametrize(("accumulate", "critic_steps"), [(1, 1), (2, 1), (1, 3), (2, 3)])
def test_epoch_has_the_updates_that_the_trainer_expects(count, accumulate, critic_steps):
    turns = [turn(i, count, accumulate, critic_steps) for i in range(count)]
    assert sum(t.ends for t in turns) == math.ceil(count / accumulate)
    assert sum(t.ends and t.net for t in turns) == math.ceil(count / (accumulate * critic_steps))
    assert turns[-1] == (True, True)


def literal(net, critics, data, first, halved=True, names=("color",)):
    """The published training written out, with gradient descent at 0.1 for both sides."""

    def descend(parameters, loss):
        parameters = list(parameters)
        for parameter, slope in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.data -= 0.1 * slope

    def criticise(number, pairs):
        loss = 0
        for index, name in enumerate(names):
            critic, real, fake = critics[name], pairs[name].target, pairs[name].output.detach()
            u = mixing((1, 0, number, 0, index), real)
            between = (fake * u + real * (1 - u)).requires_grad_(True)
            slope = torch.autograd.grad(critic(between), between, torch.ones(len(u)), create_graph=True)[0]
            penalty = ((slope.pow(2).sum((1, 2, 3)).sqrt() - 1) ** 2).mean()
            loss = loss + (critic(fake).mean() - critic(real).mean()) / (2 if halved else 1) + 10 * penalty
        descend(critics.parameters(), loss)

    for number, batch in enumerate(data):
        pairs = net.training_pairs(batch)
        if first:
            criticise(number, pairs)
        loss = sum(
            (pairs[name].output - pairs[name].target).abs().mean()
            - 0.005 * critics[name](pairs[name].output).mean()
            for name in names
        )
        if first:
            descend(net.parameters(), loss)
        else:
            slopes = torch.autograd.grad(loss, list(net.parameters()))
            for parameter, slope in zip(net.parameters(), slopes, strict=True):
                parameter.data -= 0.1 * slope
            criticise(number, pairs)


@pytest.mark.parametrize(
    ("net", "first", "halved"),
    [(LogNet, True, True), (LogNet, False, True), (LogNet, True, False), (SplitNet, False, True)],
)
def test_training_equals_the_published_one_written_out(net, first, halved):
    descent = partial(torch.optim.SGD, lr=0.1)
    trained = module(net, critic_first=first, halved=halved, optimizer=descent)
    expected = module(net)
    literal(expected.net, expected.critics, batches(6, 2), first, halved, net.compared)
    fit(trained, count=6)
    for name, tensor in expected.state_dict().items():
        assert torch.allclose(trained.state_dict()[name], tensor, rtol=1e-5, atol=1e-7), name


def test_order_of_the_updates_matters():
    ends = []
    for first in (True, False):
        trained = module(critic_first=first, adversarial_weight=1.0)
        fit(trained)
        ends.append(trained.net.base.weight.detach().clone())
    assert not torch.equal(*ends)


def test_each_compared_pair_has_a_critic_with_weights_of_its_own():
    trained = module(SplitNet)
    assert set(trained.critics) == {"diffuse", "specular"}
    assert not torch.equal(trained.critics["diffuse"].first.weight, trained.critics["specular"].first.weight)


def steps_taken(made, which):
    states = made.optimizers[which].state.values()
    return {int(state["step"]) for state in states}


@pytest.mark.parametrize(
    ("accumulate", "critic_steps", "net", "critic"),
    [(1, 1, 14, 14), (1, 3, 6, 14), (2, 1, 8, 8), (2, 2, 4, 8)],
)
def test_global_step_counts_updates_of_the_denoiser(accumulate, critic_steps, net, critic):
    # Two epochs of seven batches; the last batch of each ends both windows.
    trained = module(accumulate=accumulate, critic_steps=critic_steps)
    made = fit(trained, count=14, max_epochs=2)
    assert made.global_step == net
    assert steps_taken(made, 0) == {net}
    assert steps_taken(made, 1) == {critic}


def test_training_ends_at_max_steps_of_the_denoiser():
    made = fit(module(critic_steps=2), count=16, max_epochs=-1, max_steps=3)
    assert made.global_step == 3
    assert steps_taken(made, 1) == {6}


def test_gradients_of_accumulated_batches_are_those_of_the_joint_batch(monkeypatch):
    monkeypatch.setattr(adversarial, "mixing", lambda key, like, rank: torch.full((len(like), 1, 1, 1), 0.4))
    joint, parts = module(critic_first=False), module(accumulate=3)
    fit(joint, batch_size=6, count=12)
    fit(parts, batch_size=2, count=12)
    for name, tensor in joint.state_dict().items():
        assert torch.allclose(parts.state_dict()[name], tensor, rtol=1e-4, atol=1e-6), name


def test_clipping_limits_the_norm_of_both_gradients():
    descent = partial(torch.optim.SGD, lr=1.0)
    trained = module(gradient_clip=1e-3, optimizer=descent)
    before = {name: p.detach().clone() for name, p in trained.named_parameters()}
    fit(trained, count=2)
    for part in ("net", "critics"):
        moved = [p.detach() - before[n] for n, p in trained.named_parameters() if n.startswith(part)]
        assert float(torch.cat([m.flatten() for m in moved]).norm()) == pytest.approx(1e-3, rel=1e-3)


def test_without_adversarial_weight_there_is_no_critic_and_the_loss_is_l1():
    trained = module(adversarial_weight=0, critic_steps=5, optimizer=partial(torch.optim.SGD, lr=0.1))
    expected = module().net
    for batch in batches(4, 2):
        pair = expected.training_pairs(batch)["color"]
        slopes = torch.autograd.grad((pair.output - pair.target).abs().mean(), list(expected.parameters()))
        for parameter, slope in zip(expected.parameters(), slopes, strict=True):
            parameter.data -= 0.1 * slope
    made = fit(trained, count=4)
    assert len(trained.critics) == 0
    assert len(made.optimizers) == 1
    for name, tensor in expected.state_dict().items():
        assert torch.allclose(trained.net.state_dict()[name], tensor, rtol=1e-5, atol=1e-7), name


def test_groups_have_their_own_rates_and_frozen_ones_wait_untouched():
    trained = module(lr_scales={"modulation": 5.0}, frozen_steps={"base": 3})
    start = trained.net.base.weight.detach().clone()
    made = fit(trained, count=6)
    assert torch.equal(trained.net.base.weight, start)
    rates = {group["name"]: group["lr"] for group in made.optimizers[0].param_groups}
    assert rates == pytest.approx({"base": 1e-3, "modulation": 5e-3})
    assert set(made.optimizers[0].state) == set(trained.net.modulation.parameters())
    trained = module(lr_scales={"modulation": 5.0}, frozen_steps={"base": 3})
    made = fit(trained, count=10)
    assert not torch.equal(trained.net.base.weight, start)
    taken = {int(made.optimizers[0].state[p]["step"]) for p in trained.net.base.parameters()}
    assert taken == {2}


def test_schedules_halve_both_rates_after_epochs():
    schedule = partial(Halving, milestones=[1, 2])
    made = fit(module(lr_scheduler=schedule, lr_scales={"base": 2.0}), count=4, max_epochs=2)
    assert [group["lr"] for group in made.optimizers[0].param_groups] == pytest.approx([5e-4, 2.5e-4])
    assert made.optimizers[1].param_groups[0]["lr"] == pytest.approx(2.5e-4)


def test_schedules_per_step_count_the_updates_of_their_own_side():
    schedule = partial(Halving, milestones=[3, 6], per="step")
    made = fit(module(lr_scheduler=schedule, critic_steps=2), count=12)
    assert made.optimizers[0].param_groups[0]["lr"] == pytest.approx(5e-4)  # 3 updates
    assert made.optimizers[1].param_groups[0]["lr"] == pytest.approx(2.5e-4)  # 6 updates


def test_each_side_may_have_its_own_optimizer_and_schedule():
    made = fit(
        module(
            critic_optimizer=partial(torch.optim.SGD, lr=0.5),
            lr_scheduler=partial(Halving, milestones=[1]),
            critic_lr_scheduler=partial(Halving, milestones=[]),
        ),
        count=4,
    )
    assert made.optimizers[0].param_groups[0]["lr"] == pytest.approx(5e-4)
    assert isinstance(made.optimizers[1], torch.optim.SGD)
    assert made.optimizers[1].param_groups[0]["lr"] == 0.5


def test_checkpointing_the_denoiser_changes_nothing():
    plain, saving = module(), module(partial(LogNet, checkpointed=True))
    fit(plain)
    fit(saving)
    for name, tensor in plain.state_dict().items():
        assert torch.equal(tensor, saving.state_dict()[name]), name


def test_crops_that_do_not_fit_the_critic_are_refused():
    trained = module(critic=partial(SmoothCritic, size=16))
    with pytest.raises(ValueError, match=r"crops are 32x32 pixels.*16x16.*--data.patch_size 16"):
        fit(trained)
