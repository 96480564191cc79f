"""A named, versioned suite of captures, and the table of every back end and estimator over it."""
