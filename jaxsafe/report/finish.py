"""What follows training in a run folder: curves, the evaluation's file and picture, and a film."""

import functools
import json
from collections.abc import Mapping

import jax

from jaxsafe.config import one_line
from jaxsafe.learn.constraints import limits_by_name, limits_in_words
from jaxsafe.report import evaluation, plots
from jaxsafe.report.evaluation import Scores
from jaxsafe.report.film import film, key_of
from jaxsafe.report.stats import Estimate
from jaxsafe.report.tables import cell
from jaxsafe.run import files, run_folder
from jaxsafe.run.divergence import seeds_in_words
from jaxsafe.run.evaluate import TRAINING, keys_of_episodes
from jaxsafe.run.interrupts import Interrupts
from jaxsafe.run.policies import RunPolicies, member_policies
from jaxsafe.run.progress import Reporter
from jaxsafe.run.session import Session
from jaxsafe.run.settings import Settings, TrainConfig


def finish(session: Session, report: Reporter, stop: Interrupts) -> None:
    """Curves, evaluation and video. What fails costs one line, never the training.

    Raises:
        KeyboardInterrupt: `stop` was requested while one of them went on.
    """
    settings, folder, env = session.settings, session.folder, session.env
    train, found = settings.train, []
    run = functools.cache(
        lambda: RunPolicies(folder, settings, env, *member_policies(settings, env, folder))
    )

    def scores() -> None:
        found.extend(
            evaluation.evaluate(
                run(), train.eval_episodes, TRAINING, session.program.data, told=report.going
            )
        )
        keep_scores(found, session, report)

    def video() -> None:
        film([run().one(0)], folder / "video.mp4", filmed(train, found))

    wanted = {
        "curves": (lambda: draw_curves(session), True, ""),
        "evaluation": (
            scores,
            train.eval_episodes > 0,
            f"evaluating {settings.num_members} x {train.eval_episodes} episodes ...",
        ),
        "video": (video, train.video, "filming an episode ..."),
    }
    for name, (task, yes, about) in wanted.items():
        try:
            if yes:
                if about:
                    report.line(about)
                task()
        except Exception as error:  # training is done and saved; this is an extra
            report.line(f"no {name}: {one_line(error)}")
        if stop.requested:
            raise KeyboardInterrupt


def title_of(settings: Settings) -> str:
    return f"{settings.env_name}, {settings.algo_name}"


def draw_curves(session: Session) -> None:
    algo, metrics = session.settings.algo, run_folder.read_metrics(session.folder)
    path, title = session.folder / "curves.png", title_of(session.settings)
    plots.curves(metrics, path, title, float(algo.cost_limit), limits_by_name(algo))


def keep_scores(found: list[Scores], session: Session, report: Reporter) -> None:
    """Write evaluation.json and, of a shield, the picture of its risks; and say what was found."""
    folder, settings = session.folder, session.settings
    risks = {s.name: s.calibration for s in found if s.calibration}
    tables = {s.name: evaluation.as_json(s.rows) | {"seeds": s.seeds} for s in found}
    for name, risk in risks.items():
        tables[name]["calibration"] = risk
    whole = {"episodes": settings.train.eval_episodes, **tables.get("", tables)}
    files.write(folder / "evaluation.json", json.dumps(whole, indent=1))
    for s in found:
        share = s.rows["violation rate"].mean
        report.line(
            f"final policy{s.name and ', ' + s.name}: return {cell(s.rows['return'])}, "
            f"cost {cell(s.rows['cost'])} (limit {limits_in_words(s.limits)}), "
            f"{100 * share:.0f}% of {s.episodes} episodes over it"
            + (f"; diverged in training: {seeds_in_words(s.diverged)}" if s.diverged else "")
        )
        if compared := beside(s.rows):
            report.line(f"beside it{s.name and ', ' + s.name}: {compared}")
    if risks:
        plots.calibration(risks, folder / "calibration.png", title_of(settings))


def filmed(train: TrainConfig, found: list[Scores]) -> jax.Array:
    """The key of the episode to film: of those of the first seed the one with the median return or,
    where none was evaluated, any."""
    if not found:
        return key_of(train.seed)
    return keys_of_episodes(TRAINING, train.eval_episodes, train.seeds)[0, found[0].typical]


def beside(rows: Mapping[str, Estimate]) -> str:
    """DSRL's scores of a run on a data set, and the data's own episodes; '' of any other run."""

    def told(head: str) -> str:
        said = [f"{k.removeprefix(head)} {cell(e)}" for k, e in rows.items() if k.startswith(head)]
        return ", ".join(said)

    kinds = {"DSRL's scores": told("DSRL "), "episodes of the data": told("data ")}
    return "; ".join(f"{kind}: {said}" for kind, said in kinds.items() if said)
