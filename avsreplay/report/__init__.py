"""Rows and summaries to people and files: tables, golden comparison, gates, exports, pages. Import its modules."""
