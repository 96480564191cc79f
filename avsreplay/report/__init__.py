"""Reports of runs: summary, tables, page, golden comparison, gates, exports."""
