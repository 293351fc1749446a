"""Runs in OpenSim's environment: read a TRC, a MOT and a model with OpenSim's own readers and keep what they say."""

import sys

import numpy as np
import opensim  # pyright: ignore[reportMissingImports] - only in the rival's environment

opensim.Logger.setLevelString("error")
trc_path, mot_path, osim_path, out_path = sys.argv[1:]

trc = opensim.TimeSeriesTableVec3(trc_path)
points = np.array(
    [[trc.getRowAtIndex(row)[i].to_numpy() for i in range(trc.getNumColumns())] for row in range(trc.getNumRows())]
)
mot = opensim.TimeSeriesTable(mot_path)
labels = list(mot.getColumnLabels())

model = opensim.Model(osim_path)
state = model.initSystem()
markers = model.getMarkerSet()
names = [markers.get(i).getName() for i in range(markers.getSize())]
frames = [row for row in range(0, mot.getNumRows(), 10) if np.isfinite(mot.getMatrix().to_numpy()[row]).all()]
places = []
for row in frames:
    for column, label in enumerate(labels):
        coordinate = model.getCoordinateSet().get(label)
        value = mot.getMatrix().to_numpy()[row, column]
        rotational = coordinate.getMotionType() == opensim.Coordinate.Rotational
        coordinate.setValue(state, np.radians(value) if rotational else value, False)
    model.realizePosition(state)
    places.append([markers.get(i).getLocationInGround(state).to_numpy() for i in range(markers.getSize())])
np.savez(
    out_path,
    trc_mm=points,
    mot=mot.getMatrix().to_numpy(),
    mass_kg=model.getTotalMass(state),
    marker_names=np.array(names),
    frames=np.array(frames),
    markers_m=np.array(places),
)
