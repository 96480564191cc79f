"""Campaigns: many runs from one file, on one machine or a Dask cluster.

They resume and give the same results.
"""
