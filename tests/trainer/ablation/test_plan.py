"""Files of ablations: what ships, and what is wrong is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from models import KP, WSKP
from trainer import configs
from trainer.ablation.plan import Ablation, find_ablation, read_ablation
from trainer.configs import UsageError

SHIPPED = sorted(path.name for path in (configs.folder() / configs.ABLATIONS).glob("*.yaml"))


def shipped(name: str) -> Ablation:
    return read_ablation(find_ablation(f"ablations/{name}.yaml"))


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_ablation_has_a_header_and_stays_short(name: str) -> None:
    text = (configs.folder() / configs.ABLATIONS / name).read_text()
    assert text.startswith("# ")
    assert f"trainer ablate --config ablations/{name} --output DIR" in text
    assert text.count("\n") <= 60
    ablation = read_ablation(configs.folder() / configs.ABLATIONS / name)
    assert ablation.variants
    for variant in ablation.variants:
        assert all(file in configs.names() for file in variant.configs)
    for layout in ablation.layouts:
        assert len(ablation.placed(layout)) > 1


def test_ablations_are_found_by_path_and_by_name_and_are_no_configurations(tmp_path: Path) -> None:
    expected = configs.folder() / configs.ABLATIONS / "wskp_kernels.yaml"
    for name in ("ablations/wskp_kernels.yaml", "ablations/wskp_kernels", "wskp_kernels", str(expected)):
        assert find_ablation(name) == expected
    with pytest.raises(UsageError, match=r"none: no such file; .*ablations/wskp_branches\.yaml"):
        find_ablation("none")
    assert SHIPPED == ["realtime.yaml", "wskp_branches.yaml", "wskp_kernels.yaml"]
    assert not [name for name in configs.names() if name.startswith(configs.ABLATIONS)]


def test_options_of_all_variants_are_read(tmp_path: Path) -> None:
    variants = "variants:\n- {name: one}\n- {name: two, options: {y: 3}}\n"
    (tmp_path / "a.yaml").write_text("config: a.yaml\noptions: {x: 1, y: 2}\n" + variants)
    one, two = read_ablation(tmp_path / "a.yaml").variants
    assert one.common == two.common == {"x": 1, "y": 2}
    assert (one.options, two.options) == ({}, {"y": 3})


def test_the_networks_for_interactive_rates_are_those_of_the_paper_at_equal_steps() -> None:
    ablation = shipped("realtime")
    names = [variant.name for variant in ablation.variants]
    assert len(names) == 11
    assert {"WSKP 6 layers", "WSKP 3 layers", "KP", "MR-KP", "NBGD 2 layers", "RAE"} < set(names)
    assert len({variant.common["trainer.max_steps"] for variant in ablation.variants}) == 1


def test_the_ablation_of_kernels_has_the_kernels_of_figures_9_and_10() -> None:
    ablation = shipped("wskp_kernels")
    sizes = {v.name: tuple(v.options["model.net.kernel_sizes"]) for v in ablation.variants}
    fused = [(x, sizes[variant.name]) for variant, x in ablation.placed("figure10")]
    assert fused == [(count, tuple(range(3, 3 + 2 * count, 2))) for count in range(1, 7)]
    single = [(x, sizes[variant.name]) for variant, x in ablation.placed("figure9")]
    assert single == [(size, (size,)) for size in range(3, 15, 2)]
    rest = {v.name for v in ablation.variants} - {
        v.name for layout in ablation.layouts for v, _ in ablation.placed(layout)
    }
    assert {sizes[name] for name in rest} == {(13,) * 6}
    assert len(sizes) == 12
    for kernels in sizes.values():
        assert WSKP(kernel_sizes=kernels).kernel_sizes == kernels


def test_the_ablation_of_branches_pairs_each_network_with_itself() -> None:
    ablation = shipped("wskp_branches")
    places = {place: v for v, place in ablation.placed("table5")}
    assert set(places) == {
        (row, column) for row in ("WSKP 6 layers", "WSKP 3 layers", "KP") for column in ("w/o", "w/")
    }
    for (row, column), variant in places.items():
        assert dict(variant.options) == ({} if column == "w/" else {"model.net.branches": False})
        assert variant.configs == places[row, "w/"].configs
    deployed = [
        sum(p.numel() for p in kind(branches=branches).deploy().parameters())
        for kind in (WSKP, KP)
        for branches in (False, True)
    ]
    assert deployed[0] == deployed[1] == 27_300
    assert deployed[2] == deployed[3] == 82_250


GOOD = "config: wskp_bmfr.yaml\nlayouts: {t: {kind: pairs}, c: {kind: curve}}\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("variants: [", "is no YAML"),
        ("- a", "describes no ablation"),
        ("variants: []", "describes no ablation"),
        ("variants: [{name: a}]", "variant a: expected `config: FILE.yaml`"),
        (GOOD + "variants: [{name: a}, {name: a}]", "two variants are called 'a'"),
        (GOOD + "variants: [{name: a, option: {}}]", "unknown 'option'; expected name, config, options"),
        (GOOD + "variants: [a]", "expected a mapping with name"),
        (GOOD + "variants: [{name: a=b}]", "expected a name of up to 60 letters without"),
        (GOOD + "variants: [{name: 'a '}]", "and spaces at its ends"),
        (
            GOOD + "variants: [{name: a, places: {t: [x, y]}}, {name: b, places: {t: [x, y]}}]",
            "variant b, places, t: 'a' has the place ('x', 'y') already",
        ),
        ("layouts: {variants: {kind: pairs}}\nvariants: [{name: a}]", "choose another name"),
        ("metrics: [[psnr]]\nconfig: x\nvariants: [{name: a}]", "expected a list of some of psnr_wskp"),
        (GOOD + "variants: [{name: input}]", "none of input, reference"),
        (GOOD + "variants: [{name: a, options: [1]}]", "options: expected lines such as"),
        (GOOD + "variants: [{name: a, places: {u: 1}}]", "places: unknown 'u'; expected t, c"),
        (GOOD + "variants: [{name: a, places: {t: [x]}}]", "places, t: expected [row, column]"),
        (GOOD + "variants: [{name: a, places: {c: x}}]", "places, c: expected a number"),
        ("layouts: {t: {kind: bars}}\nvariants: [{name: a}]", "kind 'bars'; expected pairs or curve"),
        ("layouts: {a b: {kind: pairs}}\nvariants: [{name: a}]", "letters, digits and _ only"),
        ("metrics: [psnr]\nconfig: x\nvariants: [{name: a}]", "expected a list of some of psnr_wskp"),
        ("table: 1\nvariants: [{name: a}]", "unknown 'table'"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(UsageError) as stopped:
        read_ablation(path)
    assert str(path) in str(stopped.value)
    assert said in str(stopped.value)
