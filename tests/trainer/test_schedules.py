import pytest
import torch

from trainer.schedules import Halving, InverseRoot, OneCycle


def rates(steps, **options):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    schedule = OneCycle(optimizer, **options)
    schedule.span(steps)
    found = []
    for _ in range(steps + 5):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return found


def test_rate_rises_to_the_peak_falls_to_the_end_and_stays_there():
    found = rates(100, warmup=0.2, start=0.1, end=0.001)
    assert found[0] == pytest.approx(0.2)
    assert found[20] == pytest.approx(2.0)
    assert max(found) == found[20]
    assert found[100:] == pytest.approx([0.002] * 5)
    assert found[60] == pytest.approx(2.0 * (0.001 + 0.999 * 0.5))


def test_rate_depends_on_the_share_of_training_and_not_on_its_length():
    short, long = rates(50), rates(500)
    assert short[25] == pytest.approx(long[250])


def test_restored_schedule_continues():
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    schedule = OneCycle(optimizer)
    schedule.span(100)
    for _ in range(37):
        optimizer.step()
        schedule.step()
    again = OneCycle(torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0))
    again.span(100)
    again.load_state_dict(schedule.state_dict())
    assert again.get_last_lr() == schedule.get_last_lr()


def test_resuming_with_more_steps_stretches_the_cycle():
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    schedule = OneCycle(optimizer)
    schedule.span(10)
    for _ in range(10):
        optimizer.step()
        schedule.step()
    longer = OneCycle(torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0))
    longer.span(100)
    longer.load_state_dict(schedule.state_dict())
    longer.optimizer.step()
    longer.step()
    assert longer.get_last_lr() == pytest.approx([2.0 * longer.factor(11)])
    assert longer.factor(11) > 0.1


@pytest.mark.parametrize("options", [{"warmup": 1.0}, {"start": 0.0}, {"end": 2.0}])
def test_impossible_options_are_refused(options):
    with pytest.raises(ValueError, match="out of range"):
        rates(10, **options)


def halving(counts, **options):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    schedule = Halving(optimizer, **options)
    found = []
    for _ in range(counts):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return found, schedule


def test_rate_is_halved_after_each_milestone_as_in_the_paper_of_afgsa():
    found, schedule = halving(12, milestones=[3, 6, 9])
    assert found == pytest.approx([2.0] * 3 + [1.0] * 3 + [0.5] * 3 + [0.25] * 3)
    assert schedule.interval == "epoch"


def test_other_fraction_per_step_and_no_milestones():
    found, schedule = halving(4, milestones=[2], per="step", factor=0.1)
    assert found == pytest.approx([2.0, 2.0, 0.2, 0.2])
    assert schedule.interval == "step"
    assert halving(3)[0] == [2.0] * 3


def test_restored_halving_continues_and_takes_new_milestones():
    _, schedule = halving(4, milestones=[3, 6])
    assert not {"milestones", "interval", "decay"} & set(schedule.state_dict())
    again = Halving(torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0), [3, 5])
    again.load_state_dict(schedule.state_dict())
    assert again.get_last_lr() == [1.0]
    again.optimizer.step()
    again.step()
    assert again.get_last_lr() == [0.5]


@pytest.mark.parametrize(
    "options", [{"milestones": [3, 2]}, {"milestones": [0]}, {"per": "batch"}, {"factor": 1.0}]
)
def test_impossible_halvings_are_refused(options):
    with pytest.raises(ValueError, match=r"milestones must be ascending|expected epoch or step"):
        halving(1, **options)


def root_rates(epochs, **options):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.001)
    schedule = InverseRoot(optimizer, **options)
    found = []
    for _ in range(epochs):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return found


def test_inverse_root_rises_geometrically_and_falls_with_the_root_of_the_epoch():
    found = root_rates(41)
    assert found[0] == pytest.approx(1e-4)
    assert found[5] == pytest.approx(1e-3 / 10**0.5)
    assert found[10] == pytest.approx(1e-3)
    assert found[40] == pytest.approx(0.5e-3)
    assert root_rates(5, warmup=0) == pytest.approx([1e-3, 1e-3, 1e-3 / 2**0.5, 1e-3 / 3**0.5, 0.5e-3])


def test_impossible_inverse_roots_are_refused():
    with pytest.raises(ValueError, match="out of range"):
        root_rates(1, start=0)
    with pytest.raises(ValueError, match="out of range"):
        root_rates(1, warmup=-1)
