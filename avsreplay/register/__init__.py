"""Registration of a scan against a fixed model: back ends behind one contract, one ruler for all."""
