import torch

from models.ops.gradients import backward_differences


def test_differences_are_backward_first_x_of_all_channels_then_y() -> None:
    maps = torch.tensor([[[[1.0, 2, 4], [7, 11, 16]], [[0, 10, 30], [60, 100, 150]]]])
    found = backward_differences(maps)
    across = [[[0.0, 1, 2], [0, 4, 5]], [[0, 10, 20], [0, 40, 50]]]
    down = [[[0.0, 0, 0], [6, 9, 12]], [[0, 0, 0], [60, 90, 120]]]
    assert torch.equal(found, torch.tensor([across + down]))


def test_a_constant_image_has_no_gradient_borders_included() -> None:
    assert not backward_differences(torch.full((2, 3, 5, 4), 0.3)).any()
