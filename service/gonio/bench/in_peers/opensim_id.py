# pyright: basic, reportMissingImports=false
"""Runs in OpenSim's environment: inverse dynamics of one trial, timed: the tool with its files, and the bare solver.

Usage: opensim_id.py SETUP.xml FOLDER [FILE.sto]

Writes ``theirs.sto`` and ``times.json`` (rows, seconds of the tool, solver calls, seconds of the bare solver; the best of a
few rounds each), and ``read.npz`` with what OpenSim reads from FILE.sto.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import opensim

ROUNDS = 3


def main(setup: str, out: str, file: str = "") -> None:
    """Run both, and write what came out."""
    opensim.Logger.setLevelString("off")
    os.chdir(Path(setup).parent)
    folder = Path(out)
    if file:
        table = opensim.TimeSeriesTable(file)
        np.savez(folder / "read.npz", labels=table.getColumnLabels(), values=table.getMatrix().to_numpy())
    tool_s = min(run_tool(setup, folder) for _ in range(ROUNDS))
    rows = opensim.Storage(str(folder / "theirs.sto")).getSize()
    calls, solver_s = solve_bare(opensim.InverseDynamicsTool(setup), Path(setup).parent)
    times = {"rows": rows, "tool_s": tool_s, "calls": calls, "solver_s": solver_s}
    (folder / "times.json").write_text(json.dumps(times))


def run_tool(setup: str, folder: Path) -> float:
    """Run the tool from its setup to its file, and give the seconds."""
    start = time.perf_counter()
    tool = opensim.InverseDynamicsTool(setup)
    tool.setResultsDir(str(folder))
    tool.setOutputGenForceFileName("theirs.sto")
    tool.run()
    return time.perf_counter() - start


def solve_bare(tool: opensim.InverseDynamicsTool, folder: Path) -> tuple[int, float]:
    """Call the bare solver again and again in one pose, without forces: what its mathematics alone costs."""
    model = opensim.Model(str(folder / tool.getModelFileName()))
    state = model.initSystem()
    solver = opensim.InverseDynamicsSolver(model)
    udot = opensim.Vector(state.getNU(), 0.1)
    for index in range(model.getForceSet().getSize()):  # as the tool's setup excludes the muscles
        model.getForceSet().get(index).setAppliesForce(state, False)
    model.realizeVelocity(state)
    solver.solve(state, udot)
    calls, seconds = 2000, []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(calls):
            state.setTime(state.getTime() + 1e-6)  # makes the state stale, or nothing would be computed again
            solver.solve(state, udot)
        seconds.append(time.perf_counter() - start)
    return calls, min(seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
