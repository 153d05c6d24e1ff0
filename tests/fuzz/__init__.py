"""Random systems, drawn wide, under both engines, against references that share no code with `sim`.

    python -m tests.fuzz [--minutes M] [--seed S] [--case K] [--terms TERM ...]

A case is drawn from (seed, number); `--seed S --case K` repeats one and shows it. The measure is the error over what
the tolerance moves the system's own motion by: tol x max(largest of the state, sensitivity), where the sensitivity is
measured on runs whose start and constants are changed a little.
"""
