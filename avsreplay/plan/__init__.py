"""Rendezvous with a moving grasp point in least time."""

from avsreplay.plan.flight import Flight
from avsreplay.plan.rendezvous import PlanParams, rendezvous

__all__ = ["Flight", "PlanParams", "rendezvous"]
