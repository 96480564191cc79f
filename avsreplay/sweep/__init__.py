"""Campaigns: many runs from one file, on one machine or a Dask cluster, resumable, the same results in any order."""

from __future__ import annotations

from avsreplay.sweep.campaign import Campaign, load_campaign
from avsreplay.sweep.execute import execute
from avsreplay.sweep.journal import Journal
from avsreplay.sweep.plan import Plan, Point, expand
from avsreplay.sweep.results import write_results

__all__ = ["Campaign", "Journal", "Plan", "Point", "execute", "expand", "load_campaign", "write_results"]
