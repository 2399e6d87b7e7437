"""What the command line says about options of adversarial training."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from jsonargparse import Namespace

from models.critic import Critic
from tests.trainer.stand_ins import fit, module, trainer
from trainer.training import (
    check_checkpoint,
    check_manual,
    class_arguments,
    expected_critics,
    explain,
    refused,
)  # fmt: skip

VALUE = """Parser key "model":
  Does not validate against any of the Union subtypes
  Errors:
    - Parser key "critic":
        Parser key "norm":
          Expected a typing.Literal['batch', 'instance', 'none']. Got value: bad
    - Expected a <class 'NoneType'>"""
NAME = """Parser key "model":
  Errors:
    - Parser key "critic":
        Option 'nrm' is not accepted"""


def test_wrong_value_of_a_nested_option_is_said_with_the_option():
    assert explain(VALUE, set()) == (
        "option 'critic.norm': expected typing.Literal['batch', 'instance', 'none'], got bad"
    )


REFUSED = """Does not validate against any of the Union subtypes
Subtypes: [<class 'lightning.pytorch.core.module.LightningModule'>, <class 'NoneType'>]
Errors:
  - frozen_steps: ACFM has no parameter group 'bse', it has modulation, base
  - Expected a <class 'NoneType'>
Given value type: <class 'jsonargparse._namespace.Namespace'>
Given value: Namespace(class_path='trainer.modules.Adversarial')"""


def test_what_a_class_refuses_is_said_in_its_own_words():
    assert refused(REFUSED) == "frozen_steps: ACFM has no parameter group 'bse', it has modulation, base"
    assert refused("layers: expected 1 to 9") == "layers: expected 1 to 9"


def test_misspelt_argument_of_the_critic_is_recognised():
    assert {"norm", "width", "critic_steps", "milestones"} <= class_arguments()
    nested = NAME.replace("  Errors:", "  Does not validate against any of the Union subtypes\n  Errors:")
    for message in (NAME, nested):
        assert explain(message, class_arguments()).startswith("unknown option 'nrm'; did you mean 'norm'?")
    assert explain(nested, class_arguments()) == "unknown option 'nrm'; did you mean 'norm'?"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gradient_clip_val": 0.5}, "--model.gradient_clip 0.5 and --trainer.gradient_clip_val null"),
        ({"accumulate_grad_batches": 4}, "--model.accumulate 4 and --trainer.accumulate_grad_batches 1"),
    ],
)
def test_options_of_the_trainer_that_it_cannot_use_point_to_those_of_the_module(options, message):
    with pytest.raises(ValueError, match=message):
        check_manual(module(), trainer(**options))
    check_manual(module(), trainer())
    check_manual(SimpleNamespace(automatic_optimization=True), trainer(**options))


def checkpoint(path, weight=0.005, norm="batch"):
    critic = {"class_path": "models.critic.Critic", "init_args": {"norm": norm}}
    arguments = {"net": {"class_path": "models.WSKP"}, "critic": critic, "adversarial_weight": weight}
    torch.save({"hyper_parameters": arguments}, path)
    return Namespace(
        net=Namespace(class_path="models.WSKP"), adversarial_weight=weight,
        critic=Namespace(class_path=critic["class_path"], init_args=Namespace(norm=norm)),
    )  # fmt: skip


def test_training_continues_only_with_the_critic_of_the_checkpoint(tmp_path):
    path = tmp_path / "last.ckpt"
    same = checkpoint(path)
    check_checkpoint(path, same.net, expected_critics(same))
    for other in (checkpoint(tmp_path / "a.ckpt", norm="none"), checkpoint(tmp_path / "b.ckpt", weight=0.0)):
        with pytest.raises(ValueError, match=r"was trained with models.critic.Critic\(norm=batch\)"):
            check_checkpoint(path, other.net, expected_critics(other))
        check_checkpoint(path, other.net)


def test_class_path_of_the_published_critic_trains_a_denoiser():
    small = module(critic=partial(Critic, 32, "none", 2))
    before = {name: value.clone() for name, value in small.critics.state_dict().items()}
    assert fit(small, count=4).global_step == 2
    assert isinstance(small.critics["color"], Critic)
    after = small.critics.state_dict()
    # The last bias adds to both scores alike and never learns.
    assert not any(torch.equal(before[name], after[name]) for name in after if name.endswith("weight"))
