"""Figures on README and documentation pages are those of JSON files in the repository."""

from __future__ import annotations

import json
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from pixelbrax_gym.bench.ahead.targets import LAUNCH_SECONDS
from pixelbrax_gym.bench.cases import TASKS
from pixelbrax_gym.bench.tables import find, number
from tests.benchmarks import dmc_page, performance, results
from tests.benchmarks.elsewhere import CASES, identity
from tests.benchmarks.original import ORIGINAL
from tests.benchmarks.pages import drawn, without_tables
from tests.test_docs import without_code

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

PAGES = (
    "README.md",
    "docs/performance.md",
    "docs/results.md",
    "docs/measurements.md",
    "docs/dmc.md",
    "docs/accelerators.md",
)
"""Those that report measurements."""

FIGURE = re.compile(r"(?<![\w.,/-])(?:\d{1,3}(?:,\d{3})+|\d+\.\d+)(?![\w.,/-]*\d)")
"""Thousands with a comma, or a decimal fraction."""


@cache
def read(name: str) -> Any:
    return json.loads((DOCS / name).read_text("utf-8"))


def measured(machine: str, group: str, measure: str, **arguments: Any) -> Any:
    row = find(performance.rows_of(machine, group), measure, **arguments)
    return row["values"]


def span(values: list[float], form: str = "{:.2f}") -> list[str]:
    return [form.format(min(values)), form.format(max(values))]


def rounded(value: float, digits: int) -> str:
    """So many significant digits, thousands apart."""
    return f"{float(f'{value:.{digits - 1}e}'):,.0f}"


def seconds(cache: str, stage: str = "import to first step") -> float:
    return measured("cpu-avx512", "startup", "startup.first_frame", cache=cache)["seconds"][stage]


def training(num_devices: int, cores: int) -> float:
    where = {"num_devices": num_devices, "cores": cores}
    return measured("cpu-avx512", "devices", "scaling.training", **where)["steps_per_second"]


def batches(num_envs: int) -> list[float]:
    return [
        line["ratio"]
        for task in TASKS
        for line in measured("cpu-avx512", "batches", "batches.compare", task=task)
        if line["num_envs"] == num_envs
    ]


def distractor_ratios() -> list[float]:
    found = [
        line
        for num_envs in (256, 1024)
        for line in measured(
            "cpu-avx512", "distractors", "distractors.compare", task="ant", num_envs=num_envs
        )
    ]
    return [line["ratio"] for line in found if not line["distractors"].startswith("none")]


def suite_speed(task: str) -> tuple[float, float]:
    """Steps per second of a task of DM Control, ours and theirs."""
    outcomes = dmc_page.rows()
    ours = find(outcomes, "dmc.pixels", task=task)
    theirs = find(outcomes, "peers.dm_control_envs", task=task)
    return ours["values"]["steps_per_second"], theirs["values"]["steps_per_second"]


def suite_ratio(task: str) -> float:
    ours, theirs = suite_speed(task)
    return ours / theirs


def compared() -> set[str]:
    """Tasks of which both sides were timed."""
    both = ("dmc.pixels", "peers.dm_control_envs")
    timed = [
        {row["arguments"]["task"] for row in dmc_page.rows() if row["measure"] == measure}
        for measure in both
    ]
    return set.intersection(*timed)


def slowest() -> str:
    return min(compared(), key=suite_ratio)


def fastest() -> str:
    return max(compared(), key=suite_ratio)


def words(task: str) -> str:
    return task.removeprefix("dmc_").replace("_", " ")


def suite_end(name: str) -> str:
    (run,) = dmc_page.kept_runs()[name]
    return f"{results.final(run)['return']:.0f}"


def ours_to_original() -> list[float]:
    return [
        measured("cpu-avx2", "original", "throughput.scan", task=task, num_envs=num_envs)[
            "steps_per_second"
        ]
        / theirs
        for task, num_envs, theirs in ORIGINAL
    ]


def frames(peer: str) -> str:
    row = measured("cpu-avx2", "peers", peer, task="ant", num_envs=256, size=84)
    return number(row["frames_per_second"])


def ant() -> float:
    where = {"task": "ant", "num_envs": 256}
    return measured("cpu-avx2", "peers", "throughput.gymnasium", **where)["steps_per_second"]


def dm_control() -> str:
    where = {"task": "ant", "processes": 32}
    row = measured("cpu-avx2", "peers", "peers.dm_control_envs", **where)
    return f"{row['steps_per_second']:.0f}"


def held() -> list[float]:
    rows = performance.rows_of("cpu-avx512", "environments")
    pixels = [row for row in rows if row["arguments"].get("obs_mode") == "pixels"]
    return [row["values"]["bytes_per_env"] / 1e3 for row in pixels]


def adapter(name: str, num_envs: int = 256, value: str = "steps_per_second") -> float:
    rows = measured("cpu-avx512", "adapters", "adapters.compare", task="ant", num_envs=num_envs)
    return next(row[value] for row in rows if row["adapter"] == name)


def compiled(task: str, program: str, num_envs: int = 1024) -> dict[str, Any]:
    """What the compiler for an H100 made of a program."""
    rows = performance.rows_of("programs", "gpu-program")
    where = {"task": task, "program": program, "num_envs": num_envs, "card": "H100"}
    return find(rows, "compiling.gpu", **where)["values"]


def traffic_of_frames(program: str = "renderer") -> list[float]:
    drawn = [compiled(task, program) for task in TASKS]
    return [(row["read_bytes"] + row["written_bytes"]) / row["output_bytes"] for row in drawn]


def launches_of_pixels() -> list[float]:
    return [
        compiled(task, "step")["launches"] - compiled(task, "state step")["launches"]
        for task in TASKS
    ]


def tpu_frames() -> list[str]:
    """MB that drawing Ants moves on a TPU, and MB of the frames."""
    rows = performance.rows_of("programs", "tpu-program")
    values = find(rows, "compiling.tpu", task="ant", program="renderer")["values"]
    return [f"{values[name] / 1e6:.0f}" for name in ("accessed_bytes", "output_bytes")]


@cache
def groups() -> dict[str, list[dict]]:
    return results.groups(results.kept_runs())


def ends(name: str) -> list[float]:
    """Returns of the mean action at the end of the runs of that name, by seed."""
    return [results.final(run)["return"] for run in groups()[name]]


def mean_end(name: str, digits: int = 2) -> str:
    return rounded(sum(ends(name)) / len(ends(name)), digits)


def with_clips() -> list[list[dict]]:
    """Runs under videos, by algorithm and task."""
    return [seeds for seeds in groups().values() if seeds[0]["config"]["clips"]]


def error_of_ratio(run: dict) -> float:
    """Standard error of a run's return under held-out clips over that under those of training."""
    test, train = results.final(run, "test"), results.final(run, "train")
    relative = (end["standard_error"] / end["return"] for end in (test, train))
    return results.held_out_ratio([run]) * math.hypot(*relative)


def held_out_losses() -> list[str]:
    """Those ratios, seed by seed, that are more than two standard errors below 1."""
    runs = [run for seeds in with_clips() for run in seeds]
    ratios = [(results.held_out_ratio([run]), error_of_ratio(run)) for run in runs]
    return [f"{ratio:.2f}" for ratio, error in ratios if ratio < 1 - 2 * error]


def least_above(kind: str) -> str:
    """Standard errors by which every clean run is above what is earned without learning."""
    untrained = read("results/untrained.json")
    least = min(
        results.distance(run, untrained[task][kind])
        for task, of_task in results.by_task(groups()).items()
        for seeds in of_task.values()
        for run in seeds
    )
    return f"{math.floor(least)}"


def numbers_of_seeds() -> str:
    """How many seeds PPO has in the four tasks."""
    numbers = sorted({len(groups()[f"ppo-{task}"]) for task in results.TASKS})
    return " or ".join({1: "one", 2: "two", 3: "three"}[count] for count in numbers)


def without_action(task: str) -> str:
    return f"{read('results/untrained.json')[task]['none']['return']:,.0f}"


def mean_length(name: str) -> str:
    """Control steps of an episode of the mean action at the end."""
    lengths = [results.final(run)["length"] for run in groups()[name]]
    return f"{sum(lengths) / len(lengths):.0f}"


def probed(task: str) -> list[str]:
    """R² of the state, the median over its entries: by a new encoder, from features and pixels."""
    found = read("results/probe.json")[task]["median"]
    return [f"{found[inputs]:.2f}" for inputs in ("learned", "features", "pixels")]


def short_run(
    initial_std: float = 0.25, sees: str = "pixels", note: bool = False, **settings
) -> dict:
    """A short run; what is not named is as in the preset `cpu` for Ant."""
    usual = {"task": "ant", "state_critic": sees == "state", "random_shift": 0}
    usual |= {"initial_std": initial_std, "update_epochs": 2, "encoder": "patch"}
    if sees == "state":
        usual["encoder"] = "none: the state"
    (run,) = (
        run
        for run in read("results/search.json")["runs"]
        if run["sees"] == sees
        and ("note" in run) == note
        and (usual | settings).items() <= run["settings"].items()
    )
    return run


def searched(**settings) -> str:
    """The end of a short run."""
    return f"{short_run(**settings)['return in each tenth'][-1]:,.0f}"


def last_tenth(name: str) -> str:
    """Mean return of a run's training episodes in the last tenth of its steps, seed 0."""
    run = groups()[name][0]
    return f"{results.return_at(run, run['steps'][-1], 'steps', run['steps'][-1] / 10):,.0f}"


def from_state(file: str, run: str, curve: str) -> str:
    """The last return of a curve of an agent that saw the state."""
    return f"{read(f'results/{file}.json')[run][curve][-1]:,.0f}"


def noise_on_ant(agent: str) -> list[str]:
    """Mean returns of seeds 0 and 1, that began with more noise and as the preset says."""
    noisier = [results.noisier()[f"{agent}-ant-{seed}"] for seed in (0, 1)]
    return [f"{sum(both) / 2:,.0f}" for both in (noisier, ends(f"{agent}-ant")[:2])]


def not_centered(name: str) -> str:
    """Return of a longer run with pixels in [0, 1]."""
    (run,) = (run for run in read("results/centering.json")["longer_runs"] if run["name"] == name)
    return f"{run['clean/return']:,.0f}"


def long_run(rate: str) -> dict[str, list[float]]:
    """A long run of HalfCheetah, means over its twelfths."""
    return read("results/step_size.json")["runs"][f"learning rate {rate}"]


def fell() -> list[str]:
    """Million steps, highest and last return, last standard deviation by the preset's rate."""
    run = long_run("0.001")
    millions, std = run["steps"][-1] / 1e6, run["policy/std_mean"][-1]
    returns = (max(run["return"]), run["return"][-1])
    return [f"{millions:.1f}", *(f"{value:,.0f}" for value in returns), f"{std:.2f}"]


def large_updates() -> list[str]:
    """KL divergence of an iteration's updates at the beginning and the end of that run."""
    divergence = long_run("0.001")["policy/approx_kl"]
    return [f"{value:.2f}" for value in (divergence[0], divergence[-1])]


def largest_update() -> float:
    """That divergence at its largest by a smaller learning rate, in hundredths rounded up."""
    return math.ceil(max(long_run("0.0003")["policy/approx_kl"]) * 100) / 100


def balanced() -> str:
    """Mean return of the inverted pendulum's three examples, the same for all."""
    files = ("demo", "torchrl_ppo", "sb3_ppo")
    (mean,) = {read(f"benchmarks/{name}.json")["eval_return_mean"] for name in files}
    return f"{mean:.0f}"


def elsewhere(name: str) -> str:
    """What a pretrained policy earns where it was not trained."""
    return f"{read('results/elsewhere.json')[name]['return']:,.0f}"


STATEMENTS = {
    "README.md": (
        ("cheetah run make {} steps", [number(suite_speed("dmc_cheetah_run")[0])]),
        ("{} times as many as dm_control", [f"{suite_ratio('dmc_cheetah_run'):.0f}"]),
        (f"it is {{}} ({words(slowest())})", [f"{suite_ratio(slowest()):.0f}"]),
        (f"to {{}} times ({words(fastest())})", [f"{suite_ratio(fastest()):.0f}"]),
        ("256 of Brax's Ants make {}", [number(ant())]),
        ("Ant keeps {} to {} of its speed", span(distractor_ratios())),
        ("to a return of {} in", [mean_end("ppo-halfcheetah")]),
        ("reacher easy to {} of 1,000", [suite_end("ppo-dmc_reacher_easy")]),
        ("steps per second, two CPU cores | {} | 4 | {}", [number(ant()), dm_control()]),
    ),
    "docs/performance.md": (
        ("step {} to {} times", [rounded(ant(), 1), rounded(adapter("Gymnasium, torch"), 1)]),
        ("a thousand have {} to {} of their speed", span(batches(1000))),
        ("ten {} to {}", span(batches(10))),
        ("takes {} to {} kB", span(held(), "{:.0f}")),
        ("MuJoCo Warp draws {} frames", [frames("peers.mujoco_warp_renderer")]),
        ("there and PixelBrax {}", [frames("throughput.renderer")]),
        ("makes {} to {} steps a second on two", span([row[2] for row in ORIGINAL], "{:.0f}")),
        ("{} to {} times as many", [rounded(x, 2) for x in sorted(ours_to_original())[::4]]),
        ("it has {} times a Python loop's speed", [f"{adapter('JAX scan', 1, 'ratio'):.1f}"]),
        (
            "{} (cheetah) and {} (walker)",
            [
                f"{read('benchmarks/dm_control_texture.json')[domain]['ratio']:.2f}"
                for domain in ("cheetah", "walker")
            ],
        ),
        (
            "take {} s, most of it XLA's compilation; {} s with",
            [f"{seconds(cache):.0f}" for cache in ("none", "warm")],
        ),
        (
            "made, reset and stepped in {} s",
            [f"{seconds('none', 'make, reset and step once more'):.2f}"],
        ),
        ("{} steps per second on one core", [rounded(training(1, 1), 2)]),
        ("{} on two devices", [rounded(training(2, 2), 2)]),
        ("each, {} of ideal", [f"{training(2, 2) / training(1, 1) / 2:.2f}"]),
    ),
    "docs/measurements.md": (),
    "docs/dmc.md": (),
    "docs/accelerators.md": (
        ("moves {} to {} times the bytes of the frames", span(traffic_of_frames())),
        (
            "would move up to {} times as many bytes",
            [f"{max(traffic_of_frames('plain renderer')):.0f}"],
        ),
        ("to which pixels add {} or {} launches", span(launches_of_pixels(), "{:.0f}")),
        ("at least {} us a kernel", [f"{LAUNCH_SECONDS * 1e6:.1f}"]),
        ("moves {} MB for {} MB of frames", tpu_frames()),
    ),
    "docs/results.md": (
        ("**HalfCheetah** {}.", [mean_end("ppo-halfcheetah")]),
        (
            "**Walker2d** {} by the paper's reward: it walks, for {} of 1,000 steps",
            [mean_end("ppo-walker2d"), mean_length("ppo-walker2d")],
        ),
        (
            "**Ant** {}, where no action earns {}.",
            [mean_end("ppo-ant"), without_action("ant-brax")],
        ),
        (
            "**Humanoid** {}: it falls after {} of 1,000 steps",
            [mean_end("ppo-humanoid"), mean_length("ppo-humanoid")],
        ),
        ("took Humanoid to {}, and", [mean_end("ppo-humanoid-long", 3)]),
        ("no further ({}); eight", [mean_end("ppo-halfcheetah-long")]),
        ("took it to {}, one seed each", [mean_end("ppo-halfcheetah-longest-slow")]),
        ("on two CPU cores, {} seeds; mean return", [numbers_of_seeds()]),
        (
            "at least {} standard errors above the random policy, and at least {} above doing",
            [least_above("random"), least_above("none")],
        ),
        (
            "the ratios are {} to {}. For one",
            span([results.held_out_ratio(seeds) for seeds in with_clips()]),
        ),
        (
            "the standard error is {} to {}, and only PPO's",
            span([error_of_ratio(run) for seeds in with_clips() for run in seeds]),
        ),
        ("more than two of them below 1, at {}.", held_out_losses()),
        ("each with a mean of {} of 1000", [balanced()]),
        (
            "earns {} under videos, and {} under colors",
            [elsewhere(f"halfcheetah under paper-{name}") for name in ("video", "color")],
        ),
        ("earns {} by Brax's", [elsewhere("walker2d by Brax's reward")]),
        (
            "PPO earns {} in training episodes of the last tenth of as many steps, and {} with",
            [
                from_state("own_from_state", f"ant-brax std {std} seed 0", "return in each tenth")
                for std in (0.25, 0.5)
            ],
        ),
        ("from pixels it is {}.", [last_tenth("ppo-ant")]),
        (
            "an R² of {}, the median over the state's entries; a linear map from the agent's "
            "features {}, and one from the pixels averaged to 12 x 12 {}.",
            probed("ant"),
        ),
        ("The three are {}, {} and {} on Humanoid", probed("humanoid")),
        (" {}, {} and {} on Walker2d", probed("walker2d (paper)")),
        (
            "0.25 in place of 0.5 took PPO from {} to {}, PPG from {} to {}, DCPG from {} to {}",
            [end for agent in ("ppo", "ppg", "dcpg") for end in noise_on_ant(agent)],
        ),
        (
            "one seed and {} at the end, {} ({}) gained",
            [searched(), "0.15", searched(initial_std=0.15)],
        ),
        ("networks apart ({}), random", [searched(state_critic=True)]),
        ("shifts ({}) and", [searched(random_shift=2)]),
        ("layer normalisation ({}) lost", [searched(note=True)]),
        (
            "the encoder ({}) takes {} times as long",
            [
                searched(encoder="small"),
                f"{short_run(encoder='small')['seconds'] / short_run()['seconds']:.1f}",
            ],
        ),
        (
            "earns {} from pixels, and no more from the state, which it does not normalise ({})",
            [searched(task="humanoid", initial_std=0.5, sees=seen) for seen in ("pixels", "state")],
        ),
        ("four times the length ({}, before", [not_centered("ppo-walker2d-brax-long-0")]),
        (
            "With the preset's, {}, a run of eight times the length, stopped after {} million "
            "steps, rose to {} in training episodes and fell to {}: its standard deviation shrank "
            "to {}, for",
            ["0.001", *fell()],
        ),
        ("went from {} to {}. With {} it", [*large_updates(), "0.0003"]),
        ("stays below {}, and returns", [f"{largest_update():.2f}"]),
        ("rise to the end, to {} in training", [f"{long_run('0.0003')['return'][-1]:,.0f}"]),
        (
            "long run ({}, with it {})",
            [not_centered("ppo-halfcheetah-long-0"), f"{ends('ppo-halfcheetah-long')[0]:,.0f}"],
        ),
        (
            "From the state Brax's PPO reaches {}.",
            [from_state("from_state", "walker2d-brax", "return")],
        ),
    ),
}
"""Page -> what it says, and the figures in it."""

FROM_OTHERS = {
    "README.md": ("report 402,000 steps per second", "Apache License 2.0", ", 3.12)"),
    "docs/performance.md": (),
    "docs/measurements.md": ("JAX 0.10.2",),
    "docs/dmc.md": ("on MuJoCo 3.17", "differ by more than 0.01 in a velocity"),
    "docs/accelerators.md": ("JAX 0.10.2",),
    "docs/results.md": (
        "which earns up to 1,000",
        "where standing to the end would earn 1,000",
        "length is in steps, of 1,000",
        "takes 0.5 from its pixels",
        "0.6 MB each",
        "PixelBrax 0.1.0",
        "with an initial standard deviation of 0.5",
        "an initial standard deviation of 0.5 ",
        "for a standard deviation of 0.5",
    ),
}
"""Page -> what it says that is not of ours to measure."""


def plain(page: str) -> str:
    """A page's prose: neither code nor addresses nor drawn tables; spaces for line ends."""
    text = without_code(without_tables((ROOT / page).read_text("utf-8")))
    text = re.sub(r"https?://[^\s)]+|arXiv [\d.]+|Python [\d.]+", "", text)
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_says_is_what_was_measured(page):
    text = plain(page)
    for statement, figures in STATEMENTS[page]:
        assert statement.format(*figures) in text


@pytest.mark.parametrize("page", PAGES)
def test_every_figure_is_among_them(page):
    text = plain(page)
    said = [statement.format(*figures) for statement, figures in STATEMENTS[page]]
    for known in (*said, *FROM_OTHERS[page]):
        assert known in text
        text = text.replace(known, "")
    assert FIGURE.findall(text) == []


@pytest.mark.parametrize("name", ["environments", "peers", "adapters", "distractors"])
def test_tables_of_performance_are_those_of_the_results(name):
    assert drawn(performance.PAGE, name) == performance.tables()[name]


@pytest.mark.parametrize("name", ["physics", "renderer"])
def test_tables_of_measurements_are_those_of_the_results(name):
    assert drawn(performance.FORMS_PAGE, name) == performance.forms_tables()[name]


@pytest.mark.parametrize("name", ["gpu-programs", "tpu-programs"])
def test_tables_of_programs_are_those_of_the_report(name):
    assert drawn(performance.PROGRAMS_PAGE, name) == performance.programs_tables()[name]


@pytest.mark.parametrize("name", ["speed", "physics", "learned", "tasks"])
def test_tables_of_dm_control_are_those_of_the_results(name):
    assert drawn(dmc_page.PAGE, name) == dmc_page.page_tables()[name]


@pytest.mark.parametrize("name", ["clean", "baselines", "distracted", "pretrained", "centering"])
def test_tables_of_results_are_those_of_the_runs(name):
    assert drawn(results.PAGE, name) == results.tables(groups())[name]


@pytest.mark.parametrize("name", CASES)
def test_what_a_policy_earns_elsewhere_is_of_the_policy_of_today(name):
    task, *_ = CASES[name]
    assert read("results/elsewhere.json")[name]["policy"] == identity(task)


def test_a_figure_is_seen():
    text = "We make 8,160 steps, 0.94 of 4.5, version 2.0.1, arXiv 2502.00021 in 84 x 84."
    assert FIGURE.findall(text) == ["8,160", "0.94", "4.5", "2502.00021"]
