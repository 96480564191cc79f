"""The command line; no other package prints or exits."""
