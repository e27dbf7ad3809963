"""Cut full recordings down to the ones kept here: python tests/data/trim.py FULL.npz... OUT_DIR

Kept of a recording: the first steps of each natural segment; of each kind of staged segment the one
with most kinds of events; and the steps around any event that is still missing. Of layout samples the
first 1000. `--layouts` keeps these and no steps.
"""

import json
import sys
from pathlib import Path

import numpy as np

NATURAL = {"random": 16, "task": 8, "obstacle": 4}  # steps
LAYOUTS = 1000
STATE = ("qpos", "qvel", "qacc_warmstart", "time", "goal_pos", "goal_button", "buttons_timer")
STATE += ("episode_step", "last_dist_goal", "last_dist_box", "last_box_goal", "last_robot_com")
SEGMENT = ("seed", "robot_xy0", "robot_rot0", "body_pos", "body_quat", "qpos0", "layout")


def pieces(full: dict[str, np.ndarray], meta: dict) -> list[tuple[int, int, int]]:
    """Stretches (segment, first step, end) to keep."""
    first, count = full["seg.first_step"], full["seg.n_steps"]
    events = {k: v > 0 for k, v in full.items() if k.startswith("step.cost")}
    events |= {k: full[f"step.{k}"] for k in ("goal_met", "done")}
    kept: list[tuple[int, int, int]] = []
    richest: dict[str, int] = {}

    def richness(g: int) -> int:
        return sum(int(e[first[g] : first[g] + count[g]].any()) for e in events.values())

    for g, label in enumerate(meta["segment_labels"]):
        kind, name = label.split(":")
        if kind == "natural":
            kept.append((g, first[g], first[g] + min(count[g], NATURAL[name])))
        elif label not in richest or richness(g) > richness(richest[label]):
            richest[label] = g
    kept += [(g, first[g], first[g] + count[g]) for g in richest.values()]
    for happened in events.values():
        where = np.flatnonzero(happened)
        if len(where) and not any(((where >= a) & (where < b)).any() for _, a, b in kept):
            g = int(np.searchsorted(first, where[0], "right")) - 1
            kept.append((g, max(first[g], where[0] - 2), min(first[g] + count[g], where[0] + 3)))
    return kept


def trim(path: Path, layouts_only: bool) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        full = {k: file[k] for k in file.files}
    meta = json.loads(str(full["meta"]))
    out = {k: v[:LAYOUTS] for k, v in full.items() if k.startswith("layout.")}
    out["meta"] = np.array(json.dumps(meta))
    if layouts_only:
        return out
    kept = pieces(full, meta)
    lengths = [b - a for _, a, b in kept]
    steps = np.concatenate([np.arange(a, b) for _, a, b in kept])
    rows = np.concatenate([full["step.state"][a] + np.arange(b - a + 1) for _, a, b in kept])
    segments = [g for g, _, _ in kept]
    meta["segment_labels"] = [meta["segment_labels"][g] for g in segments]
    per_step = [k for k in full if k.startswith(("step.", "spread."))]
    out = {k: full[k][steps] for k in per_step}
    out |= {f"state.{k}": full[f"state.{k}"][rows] for k in STATE if f"state.{k}" in full}
    out |= {f"seg.{k}": full[f"seg.{k}"][segments] for k in SEGMENT}
    out["obs_flat"] = full["obs_flat"][rows]
    starts = np.cumsum([0, *lengths[:-1]])
    out["seg.n_steps"], out["seg.first_step"] = np.array(lengths), starts
    out["seg.first_state"] = starts + np.arange(len(kept))
    out["step.state"] = np.arange(len(steps)) + np.repeat(np.arange(len(kept)), lengths)
    out["meta"] = np.array(json.dumps(meta))
    return out


if __name__ == "__main__":
    *paths, folder = (a for a in sys.argv[1:] if a != "--layouts")
    only = "--layouts" in sys.argv
    for path in map(Path, paths):
        name = f"layouts_{path.name}" if only else path.name
        np.savez_compressed(Path(folder) / name, allow_pickle=False, **trim(path, only))
