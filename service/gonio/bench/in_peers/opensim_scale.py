# pyright: basic, reportMissingImports=false
"""Runs in OpenSim's environment: its ScaleTool on a setup file; the results go where the setup says.

Usage: opensim_scale.py SETUP.xml
"""

import os
import sys
from pathlib import Path

import opensim


def main(setup: str) -> None:
    """Scale the model and place its markers."""
    opensim.Logger.setLevelString("off")
    os.chdir(Path(setup).parent)  # from elsewhere OpenSim's tools crash
    if not opensim.ScaleTool(setup).run():
        sys.exit("the ScaleTool failed")


if __name__ == "__main__":
    main(*sys.argv[1:])
