"""Train what the results lack: python docs/results/run.py --gpus 0,1 --at-once 4

Every task with every algorithm, 5 seeds and 10 million steps each, several commands on a GPU (start
NVIDIA's multi-process service first, see ../performance.md). Button has Safety-Gymnasium's rules, those
of the published figures; Goal's are the same in both, and of Push none are published.

A run that is done comes here, its metrics with five digits and compressed; one that is stopped, by
Ctrl-C or after --minutes, continues the next time. With --compat omnisafe it has OmniSafe's
conventions, and a folder of its own name. With options of train.py it is a trial, which stays in
--runs. Then `python docs/results/make.py` draws curves and writes tables. Exit status: 0 if nothing
is left to do, 130 if stopped, 1 if a run failed.
"""

import argparse
import csv
import lzma
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
TASKS = [f"{robot}_{task}" for task in ("goal1", "goal2", "push1", "button1", "button2")
         for robot in ("point", "car")]  # fmt: skip
MAIN = ["ppo", "ppo_lag", "trpo_lag", "cppo_pid", "cpo", "pcpo", "focops", "cup"]  # first
ALGOS = [
    *MAIN, "pg", "npg", "trpo", "rcpo", "p3o", "trpo_pid", "ppo_saute", "trpo_saute", "ppo_simmer_pid",
    "trpo_simmer_pid", "ppo_early_terminated", "trpo_early_terminated",
]  # fmt: skip


def options(task: str, algo: str) -> list[str]:
    """What a run has besides its algorithm's defaults: OmniSafe's settings of Button."""
    if "button" not in task:
        return ["env.rules=safety_gym"]
    unsafe = ["algo.saute_discount=0.999", "algo.unsafe_reward=-1"]
    return ["env.rules=safety_gymnasium", *(unsafe if "saute" in algo or "simmer" in algo else [])]


def keep(run: Path, name: str) -> None:
    """Copy what a finished run leaves here, as if it had been trained in runs/."""
    (HERE / name).mkdir(exist_ok=True)
    part = HERE / name / "metrics.csv.xz.part"
    with (run / "metrics.csv").open(newline="") as plain, lzma.open(part, "wt", preset=9) as packed:
        header, *rows = csv.reader(plain)
        where = header.index("seconds") + 1  # the metrics, of which five digits are kept
        rounded = ([*row[:where], *(x and f"{float(x):.5g}" for x in row[where:])] for row in rows)
        csv.writer(packed, lineterminator="\n").writerows([header, *rounded])
    for file in ("config.yaml", "versions.json", "evaluation.json"):
        if (run / file).exists():
            text = (run / file).read_text().replace(str(run), f"runs/{name}").replace(f"{ROOT}/", "")
            (HERE / name / file).write_text(text)
    part.replace(HERE / name / "metrics.csv.xz")  # last: with it the run is done


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("options", nargs="*", metavar="key=value", help="of train.py, for a trial")
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--algos", nargs="+", default=ALGOS)
    parser.add_argument("--compat", default="none", choices=["none", "omnisafe"])
    parser.add_argument("--gpus", default="0", help="their indices, with commas between")
    parser.add_argument("--at-once", type=int, default=1, help="commands on each GPU")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="then stop")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "results")
    args = parser.parse_args()

    end = time.monotonic() + 60 * args.minutes
    suffix = "" if args.compat == "none" else f"-{args.compat}"
    names = [(f"{task}-{algo}{suffix}", task, algo) for task in args.tasks for algo in args.algos]
    names.sort(key=lambda job: job[2] not in MAIN)
    todo: queue.SimpleQueue = queue.SimpleQueue()
    missing = [job for job in names if not (HERE / job[0] / "metrics.csv.xz").exists()]
    for job in sorted(missing, key=lambda job: not (args.runs / job[0]).exists()):  # those begun first
        todo.put(job)
    failed, left, stopping = [], [], threading.Event()

    def work(gpu: str) -> None:
        while True:
            try:
                job = todo.get_nowait()
            except queue.Empty:
                return
            try:
                train(*job, gpu)
            except Exception as error:
                failed.append(job[0])
                print(f"{job[0]}: {error!r}", flush=True)

    def train(name: str, task: str, algo: str, gpu: str) -> None:
        if stopping.is_set() or time.monotonic() >= end:
            left.append(name)
            return
        run = args.runs / name
        run.parent.mkdir(parents=True, exist_ok=True)
        command = [
            sys.executable, str(ROOT / "scripts" / "train.py"), f"env={task}", f"algo={algo}",
            *options(task, algo), f"compat={args.compat}", "num_seeds=5", "total_steps=1e7",
            "video=false", f"run_dir={run}", "resume=true",
            *args.options,
        ]  # fmt: skip
        own = {"CUDA_VISIBLE_DEVICES": gpu, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        begun = time.monotonic()
        with run.with_suffix(".log").open("a") as log:
            process = subprocess.Popen(
                command,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | own,
                start_new_session=True,  # Ctrl-C is passed on once, below
            )
            while process.poll() is None:
                if stopping.wait(1) or time.monotonic() >= end:
                    process.send_signal(signal.SIGINT)
                    process.wait()
        if process.returncode == 0:
            what = "done"
            if not args.options:
                keep(run, name)
        elif process.returncode in (130, -signal.SIGINT):
            what = "stopped"
            left.append(name)
        else:
            what = f"failed, see {run.with_suffix('.log')}"
            failed.append(name)
        print(f"{name}: {what}, {(time.monotonic() - begun) / 60:.1f} minutes", flush=True)

    for ending in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(ending, lambda *_: stopping.set())
    workers = [
        threading.Thread(target=work, args=(gpu,)) for gpu in args.gpus.split(",") * args.at_once
    ]
    print(f"{todo.qsize()} of {len(names)} runs to do", flush=True)
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    print(f"left to do: {', '.join(left + failed) or 'nothing'}")
    return 1 if failed else 130 if left else 0


if __name__ == "__main__":
    sys.exit(main())
