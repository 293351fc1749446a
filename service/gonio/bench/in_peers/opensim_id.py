# pyright: basic, reportMissingImports=false
"""Runs in OpenSim's environment: inverse dynamics of one trial, timed: the tool with its files, and the bare solver.

Usage: opensim_id.py SETUP.xml FOLDER

Writes ``inverse_dynamics.sto`` and ``times.json`` (rows, seconds of the tool, solver calls, seconds of the bare solver).
"""

import json
import os
import sys
import time
from pathlib import Path

import opensim


def main(setup: str, out: str) -> None:
    """Run both, and write what came out."""
    opensim.Logger.setLevelString("off")
    os.chdir(Path(setup).parent)
    folder = Path(out)
    start = time.perf_counter()
    tool = opensim.InverseDynamicsTool(setup)
    tool.setResultsDir(str(folder))
    tool.setOutputGenForceFileName("inverse_dynamics.sto")
    tool.run()
    tool_s = time.perf_counter() - start
    rows = opensim.Storage(str(folder / "inverse_dynamics.sto")).getSize()
    calls, solver_s = solve_bare(tool, Path(setup).parent)
    times = {"rows": rows, "tool_s": tool_s, "calls": calls, "solver_s": solver_s}
    (folder / "times.json").write_text(json.dumps(times))


def solve_bare(tool: opensim.InverseDynamicsTool, folder: Path) -> tuple[int, float]:
    """Call the bare solver again and again in one pose, without forces: what its mathematics alone costs."""
    model = opensim.Model(str(folder / tool.getModelFileName()))
    state = model.initSystem()
    solver = opensim.InverseDynamicsSolver(model)
    udot = opensim.Vector(state.getNU(), 0.1)
    model.realizeVelocity(state)
    solver.solve(state, udot)
    calls = 2000
    start = time.perf_counter()
    for _ in range(calls):
        state.setTime(state.getTime() + 1e-6)
        solver.solve(state, udot)
    return calls, time.perf_counter() - start


if __name__ == "__main__":
    main(*sys.argv[1:])
