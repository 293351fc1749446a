"""The virtual laboratory: people, cameras and soles whose truth is known."""

from gonio.kernel.virtual_lab.steps import Limp
from gonio.kernel.virtual_lab.walker import grow, truth_at, walk

__all__ = ["Limp", "grow", "truth_at", "walk"]
