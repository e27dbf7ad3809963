"""A run, from its arguments to its folder.

    arguments               key=value -> plain values
    hydra_jobs              the same for train, by Hydra, which then calls the job of each run
    plain                   plain values merged, compared and written as text
    settings, compat        plain values -> checked Settings
    choice                  names or objects from a caller in Python -> options and Extras
    flags, help             flags of commands; what --help of train prints
    session                 the folder, the environment, the program; then the loop and what follows it
    programs                an algorithm over settings, seeds and devices -> Program
    memory, devices         whether it fits, and on what it runs
    distributed             several processes, which run one program in step
    loop                    compile, update, log, evaluate, checkpoint
    clock, divergence       when a run ends; whether it still learns
    log, loggers, progress  what it says: to the folder, to callbacks and to the terminal
    interrupts              Ctrl-C and its like
    run_folder, checkpoint  what lies in the folder; files opens all of it
    policies, evaluate      policies, read from a folder; fresh episodes of them
    dataset, collect        data sets for offline learning: read and written; made by policies
    sweep                   many settings in few programs; sweep_plan says which, sweep_folder keeps it

`jaxsafe.commands.train` calls hydra_jobs, settings and session in this order; `jaxsafe.report.finish`
draws, evaluates and films at the end.
"""
