# pyright: basic, reportMissingImports=false
"""Runs in OpenSim's environment: inverse kinematics of one trial, timed: the bare solver, and the tool with its files.

Usage: opensim_ik.py SETUP.xml ACCURACY FOLDER

Writes ``ik.mot`` and ``times.json`` (frames, and seconds of the solver and of the tool) into the folder.
"""

import json
import os
import sys
import time
from pathlib import Path

import opensim


def main(setup: str, accuracy: str, out: str) -> None:
    """Run both, and write what came out."""
    opensim.Logger.setLevelString("off")
    os.chdir(Path(setup).parent)  # from elsewhere the tool crashes
    folder = Path(out)
    start = time.perf_counter()
    tool = opensim.InverseKinematicsTool(setup)
    tool.set_accuracy(float(accuracy))
    tool.setResultsDir(str(folder))
    tool.setOutputMotionFileName(str(folder / "ik.mot"))
    tool.run()
    tool_s = time.perf_counter() - start
    frames, solver_s = track(tool, Path(setup).parent, float(accuracy))
    times = {"frames": frames, "tool_s": tool_s, "solver_s": solver_s}
    (folder / "times.json").write_text(json.dumps(times))


def track(tool: opensim.InverseKinematicsTool, folder: Path, accuracy: float) -> tuple[int, float]:
    """Track the trial with the bare solver; only the solver's own calls are timed."""
    model = opensim.Model(str(folder / tool.get_model_file()))
    state = model.initSystem()
    weights, coordinates = opensim.SetMarkerWeights(), opensim.SimTKArrayCoordinateReference()
    tasks = tool.getIKTaskSet()
    for index in range(tasks.getSize()):
        task = tasks.get(index)
        if task.getApply() and task.getConcreteClassName() == "IKMarkerTask":
            weights.cloneAndAppend(opensim.MarkerWeight(task.getName(), task.getWeight()))
        elif task.getApply():
            coordinate = model.getCoordinateSet().get(task.getName())
            value = opensim.Constant(coordinate.getDefaultValue())
            reference = opensim.CoordinateReference(task.getName(), value)
            reference.setWeight(task.getWeight())
            coordinates.push_back(reference)
    observed = opensim.MarkersReference(str(folder / tool.getMarkerDataFileName()), weights)
    solver = opensim.InverseKinematicsSolver(model, observed, coordinates, 20.0)
    solver.setAccuracy(accuracy)
    times = [time_s for time_s in observed_times(observed) if tool.getStartTime() <= time_s <= tool.getEndTime()]
    start = time.perf_counter()
    state.setTime(times[0])
    solver.assemble(state)
    for time_s in times:
        state.setTime(time_s)
        solver.track(state)
    return len(times), time.perf_counter() - start


def observed_times(observed: opensim.MarkersReference) -> tuple[float, ...]:
    """Give the times of the trial's frames."""
    return observed.getMarkerTable().getIndependentColumn()


if __name__ == "__main__":
    main(*sys.argv[1:])
