"""One estimation problem over the poses of a log, whose events are variables."""
