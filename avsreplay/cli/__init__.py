"""The command line. Only this package prints or ends the process."""
