"""Random systems, drawn wide, under both engines, against references that share no code with `sim`, and other runs.

    python -m tests.fuzz [--minutes M] [--seed S] [--case K] [--terms TERM ...] [--against JUDGE ...]

A case is drawn from (seed, number); `--seed S --case K` repeats one and shows it. The measure is the error over what
the tolerance moves the system's own motion by: tol x max(largest of the state, sensitivity), where the sensitivity is
measured on runs whose start and constants are changed a little. Relations (a mirror image, a restart, another frame:
`tests.fuzz.relations`) need no reference, and hold at any size and with all terms.
"""
