"""A run, from its arguments to its folder.

    arguments               key=value and Hydra -> plain values
    settings, compat        plain values -> checked Settings
    session                 the folder, the environment, the program; then the loop and what follows it
    programs                an algorithm over settings, seeds and devices -> Program
    memory, devices         whether it fits, and on what it runs
    distributed             several processes, which run one program in step
    loop                    compile, update, log, evaluate, checkpoint
    clock, divergence       when a run ends; whether it still learns
    log, loggers, progress  what it says: to the folder, to callbacks and to the terminal
    run_folder, checkpoint  what lies in the folder; files opens all of it
    policies, evaluate      policies, read from a folder; fresh episodes of them
    dataset, collect        data sets for offline learning: read and written; made by policies
    sweep                   many settings in few programs

`jaxsafe.commands.train` calls arguments, settings and session in this order; `jaxsafe.report.finish`
draws, evaluates and films at the end.
"""
