"""What follows training in a run folder: curves, the evaluation's file and picture, and a film."""

import functools
import json
from collections.abc import Mapping

from jaxsafe.config import one_line
from jaxsafe.learn.constraints import limits_by_name, limits_in_words
from jaxsafe.report import evaluation, plots
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


def finish(session: Session, report: Reporter, stop: Interrupts) -> None:
    """Curves, evaluation and video. What fails costs one line, never the training.

    Raises:
        KeyboardInterrupt: `stop` was requested while one of them went on.
    """
    settings, folder, env = session.settings, session.folder, session.env
    train = settings.train
    title = f"{settings.env_name}, {settings.algo_name}"
    run = functools.cache(
        lambda: RunPolicies(folder, settings, env, *member_policies(settings, env, folder))
    )

    def curves() -> None:
        limit = float(settings.algo.cost_limit)
        metrics, limits = run_folder.read_metrics(folder), limits_by_name(settings.algo)
        plots.curves(metrics, folder / "curves.png", title, limit, limits)

    filmed = key_of(train.seed)

    def scores() -> None:
        nonlocal filmed
        found = evaluation.evaluate(run(), train.eval_episodes, TRAINING, session.program.data)
        filmed = keys_of_episodes(TRAINING, train.eval_episodes, train.seeds)[0, found[0].typical]
        risks = {s.name: s.calibration for s in found if s.calibration}
        tables = {s.name: evaluation.as_json(s.rows) | {"seeds": s.seeds} for s in found}
        for name, risk in risks.items():
            tables[name]["calibration"] = risk
        text = json.dumps({"episodes": train.eval_episodes, **tables.get("", tables)}, indent=1)
        files.write(folder / "evaluation.json", text)
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
            plots.calibration(risks, folder / "calibration.png", title)

    def video() -> None:
        film([run().one(0)], folder / "video.mp4", filmed)

    wanted = {
        "curves": (curves, True, ""),
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


def beside(rows: Mapping[str, Estimate]) -> str:
    """DSRL's scores of a run on a data set, and the data's own episodes; '' of any other run."""

    def told(head: str) -> str:
        said = [f"{k.removeprefix(head)} {cell(e)}" for k, e in rows.items() if k.startswith(head)]
        return ", ".join(said)

    kinds = {"DSRL's scores": told("DSRL "), "episodes of the data": told("data ")}
    return "; ".join(f"{kind}: {said}" for kind, said in kinds.items() if said)
