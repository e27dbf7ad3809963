"""A run, from its arguments to its folder.

    arguments           key=value and Hydra -> plain values
    settings            plain values -> checked Settings
    session             the folder, the environment, the program; then the loop and what follows it
    programs            an algorithm over settings, seeds and devices -> Program
    memory, devices     whether it fits, and on what it runs
    loop                compile, update, log, evaluate, checkpoint
    log, run_folder     what goes into the folder, with checkpoint and progress
    policies, evaluate  policies, read from a folder; fresh episodes of them
    sweep               many settings in few programs

`jaxsafe.commands.train` calls arguments, settings and session in this order; `jaxsafe.report.finish`
draws, evaluates and films at the end.
"""
