"""What the process loads that local workers are forked from; imported there for its effect."""

from importlib import import_module

from stickslip.pipeline.machine.processes import loading

with loading():
    import pandas  # noqa: F401  Arrow loads it when it is first given a list

    from stickslip.pipeline.dataset.program import program
    from stickslip.pipeline.running import cluster, worker  # noqa: F401
    from stickslip.sim import engines

    for engine in engines.ENGINES.values():
        if engine.kernels:
            import_module(f"{engine.kernels}.integrate")
    program()  # found once for all that are forked
