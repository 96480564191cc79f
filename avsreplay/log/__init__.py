"""The door for bytes: logs, bags and folders in; MCAP out."""
