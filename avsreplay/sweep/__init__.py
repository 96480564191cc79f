"""Campaigns: many runs from one file, on one machine or a Dask cluster; they resume and give the same results."""

from __future__ import annotations

from avsreplay.sweep.campaign import Campaign, load_campaign
from avsreplay.sweep.execute import run_tasks
from avsreplay.sweep.expansion import Expansion, Point, expand
from avsreplay.sweep.journal import Journal
from avsreplay.sweep.results import write_results

__all__ = ["Campaign", "Expansion", "Journal", "Point", "expand", "load_campaign", "run_tasks", "write_results"]
