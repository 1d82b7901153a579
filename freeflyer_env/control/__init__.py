"""Flying a plan: the reference, trackers with one interface, pulse-width modulation.

:class:`PIDTracker` is the paper's controller. Every tracker is a :class:`Tracker`.
"""

from freeflyer_env.control.flight import Flight, fly
from freeflyer_env.control.lqr import LQRTracker
from freeflyer_env.control.modulation import PulseWidthModulator
from freeflyer_env.control.mpc import TrackingMPC
from freeflyer_env.control.observer import DisturbanceObserver
from freeflyer_env.control.pid import PIDTracker
from freeflyer_env.control.reference import Tracker, reference_at
from freeflyer_env.control.replanning import ReplanningTracker

__all__ = [
    "DisturbanceObserver",
    "Flight",
    "LQRTracker",
    "PIDTracker",
    "PulseWidthModulator",
    "ReplanningTracker",
    "Tracker",
    "TrackingMPC",
    "fly",
    "reference_at",
]
