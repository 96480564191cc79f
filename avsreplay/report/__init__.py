"""Rows to people and files: tables, golden comparison, exports, pages."""
