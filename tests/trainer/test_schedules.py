import pytest
import torch

from trainer.schedules import OneCycle


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
