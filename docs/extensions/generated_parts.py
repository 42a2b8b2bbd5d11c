"""
Generates parts of pages from the package and from ``benchmarks/results``.

A line ``<!-- generated: NAME -->`` of a page is replaced by Markdown, each time that the page is
read.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import agents
import benchmark_results
import catalogue
import import_picture
import reference
import summaries

# Table, and its variants at both ends of the gap: planning in the data sheet's twin and in the true
# one, of the worn pendulum.
WORN = ("hds_parts", "wrong twin", "ceiling")

# Methods with which the page of an algorithm compares it.
LEARNED = {
    "hds": ("sac", "sb3_sac", "sbx_sac"),
    "gsde_sac": ("sb3_gsde_sac", "sac", "sb3_sac", "sbx_sac"),
    "droq": ("sbx_droq", "sac"),
    "crossq_jax": ("crossq_jax_512", "crossq_jax_narrow", "contrib_crossq", "sbx_crossq", "sac"),
    "tqc_jax": ("contrib_tqc", "sbx_tqc", "sac"),
    "simba": ("simba_narrow", "sac", "sb3_sac", "sbx_sac"),
    "td7": ("sac", "sb3_sac", "sbx_sac"),
    "bro": ("bro_fast", "bro_fast_narrow", "sac", "sb3_sac", "sbx_sac"),
}

PARTS: dict[str, Callable[[], str]] = {
    "imports": import_picture.as_markdown,
    "reference": reference.as_markdown,
    "twins": catalogue.twins_as_markdown,
    "surrogates": catalogue.surrogates_as_markdown,
    "effects": catalogue.effects_as_markdown,
    "nameless": catalogue.nameless_as_markdown,
    "environments": catalogue.environments_as_markdown,
    "trained_agents": agents.as_markdown,
    "benchmarks": lambda: benchmark_results.as_markdown(pages_by_result()),
    "pendulum": summaries.complete("pendulum"),
    "epoch_cost": summaries.complete("epoch_cost", "time and memory of an epoch against rollouts"),
    "import_time": summaries.complete("import_time"),
    "qp_solvers": summaries.complete("qp_solvers"),
    "sim_to_real_gap": summaries.complete(
        "sim_to_real_gap", "share of the gap that is closed, by cell"
    ),
    "sim_to_real_ahead": summaries.complete("sim_to_real_ahead"),
    "sim_to_real_median": summaries.complete("sim_to_real_median"),
    "payload_added": summaries.complete("payload_added_recovery"),
    "ten_minutes": summaries.first_and_rest(
        "ten_minutes", 3, "return of each episode against minutes"
    ),
    "control_tasks": summaries.over_seeds("control_tasks", "env", "return", "seconds"),
    "hds_parts": summaries.over_seeds(
        "hds_parts",
        "variant",
        "return",
        ends=WORN,
        shows="return with each part switched off, a dot for each seed",
    ),
    "open_loop": summaries.gaits,
    "open_loop_scores": summaries.complete(
        "open_loop_scores", "scores of open loop and PPO in each environment and over all of them"
    ),
    "robustness_return": summaries.crossed(
        "robustness", ("env", "policy"), ("perturbation",), "return"
    ),
    "robustness_share": summaries.crossed(
        "robustness", ("env", "policy"), ("perturbation",), "share"
    ),
    "action_scale": summaries.complete("action_scale_reached"),
    "action_scale_short": summaries.complete("action_scale_wheelbase_0.4_reached"),
    "action_scale_steering": summaries.complete("action_scale_steering_reached"),
    "action_scale_sharp": summaries.complete("action_scale_steering_wheelbase_0.25_reached"),
    "action_scale_racing": summaries.complete("action_scale_steering_wheelbase_0.25_sde_reached"),
    "safe_swing_up": summaries.over_seeds(
        "safe_swing_up",
        "without",
        "return",
        "violations",
        "continuity",
        shows="return, hits of the rail's ends and continuity cost, with all and without each",
    ),
    "cpg_prior": summaries.crossed("cpg_prior", ("prior",), ("env", "learner"), "return"),
    "elastic_quadruped": summaries.over_seeds(
        "elastic_quadruped",
        "method",
        "return",
        shows="return after 50,000 steps with each method, a dot for each seed",
    ),
    **{
        f"hidden_effects_{part}": summaries.complete(f"hidden_effects_{part}")
        for part in ("targets", "kinds", "difficulty", "causes", "systems", "outside", "rules")
    },
    **{
        f"hidden_effects_{part}": summaries.complete(f"hidden_effects_quick_{part}")
        for part in ("several", "several_conditions", "several_rules")
    },
    "hidden_effects_picture": summaries.picture(
        "hidden_effects", "rates with intervals beside their targets, right names against size"
    ),
    "policy_gain": summaries.complete("policy_gain_intervals"),
    "policy_gain_picture": summaries.picture(
        "policy_gain", "return on the real system of policies from each twin, a line for each seed"
    ),
    "next_experiment_settled": summaries.complete("next_experiment_settled"),
    "next_experiment_bands": summaries.complete("next_experiment_bands"),
    "uncertain_verdicts": summaries.complete("uncertain_verdicts_intervals"),
    "diagnosis_cost": summaries.complete(
        "diagnosis_cost", "seconds of a diagnosis against the number of recordings"
    ),
    "model_files": summaries.complete("model_files"),
    "locomotion": summaries.complete("locomotion"),
    "locomotion_cost": summaries.complete("locomotion_cost"),
    "joints_cost": summaries.complete("joints_cost"),
    "cluster_overhead": summaries.complete("cluster_overhead"),
    "start_up": summaries.complete("start_up_summary"),
    "diagnosis_cost_lines": summaries.complete("diagnosis_cost_lines"),
    **{f"learned_{method}": summaries.learned(method, *peers) for method, peers in LEARNED.items()},
    "learned": summaries.learned(),
    "learned_papers": summaries.complete("model_free_papers"),
    "learned_peers": summaries.complete("model_free_peers", digits=4),
    "learned_fewer_steps": summaries.complete("model_free_fewer_steps"),
    **{
        f"learned_on_{env.partition('-')[0]}": summaries.picture(
            f"model_free_{env}",
            f"return on {env} against steps and against wall time: a line for each method, a band "
            "over its seeds",
        )
        for env in (
            "Pendulum-v1",
            "MountainCarContinuous-v0",
            "InvertedPendulum-v5",
            "HalfCheetah-v5",
            "Hopper-v5",
        )
    },
    "gsde_continuity": summaries.over_seeds(
        "gsde_continuity",
        ("env", "noise"),
        "return",
        "continuity",
        "continuity_of_mean",
        shows="return of the mean policy against the continuity cost while learning",
    ),
    "sb3_tests": summaries.complete("sb3_tests_table"),
    "speed": summaries.complete("speed_targets"),
    "speed_on_cuda": summaries.complete("speed_cuda_targets"),
    "speed_of_sbx_on_cuda": summaries.complete("speed_cuda_sbx_sb3"),
    "speed_products": summaries.complete("speed_products"),
    "speed_of_sbx": summaries.complete("speed_sbx_sb3"),
    "speed_start_up": summaries.complete("speed_start_up"),
    "speed_alone": summaries.complete("speed_alone"),
    "hds_weaknesses": summaries.over_seeds(
        "hds_weaknesses",
        "variant",
        "return",
        shows="return with each remedy off and on, a dot for each seed",
    ),
    "hds_beta": summaries.over_seeds(
        "hds_beta",
        "variant",
        "return",
        "dropped_samples",
        "gradient_norm",
        "derivative_median",
        "derivative_worst",
        ends=WORN,
        shows="return, gradient and derivative against the share, a line for each seed",
    ),
}

_DOCS = Path(__file__).parent.parent
_LINE = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
_RESULT = re.compile(r"benchmarks/results/([\w.-]+)\.(?:csv|png)")


def fill_in(text: str) -> str:
    """
    :param text: of a page
    :return: the same text with its generated parts in place
    :raises KeyError: for a part that does not exist
    """
    return _LINE.sub(lambda line: PARTS[line[1]](), text)


def pages_by_result() -> dict[str, list[str]]:
    """:return: for each table or picture, the pages that show it, relative to a folder of docs"""
    pages: dict[str, list[str]] = {}
    for page in sorted([*_DOCS.glob("*.md"), *_DOCS.glob("[!_]*/[!_]*.md")]):
        text = page.read_text()
        parts = [PARTS[name] for name in _LINE.findall(text)]
        shown = [text, *(part() for part in parts if part.__module__ == summaries.__name__)]
        for name in dict.fromkeys(_RESULT.findall("\n".join(shown))):
            pages.setdefault(name, []).append(f"../{page.relative_to(_DOCS).as_posix()}")
    return pages


def setup(app: Any) -> dict[str, bool]:
    """What Sphinx calls."""

    def read(_: Any, page: str, content: list[str]) -> None:
        if _LINE.search(content[0]):
            app.env.note_reread()
        content[0] = fill_in(content[0])

    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
