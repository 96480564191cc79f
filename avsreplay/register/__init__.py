"""Registration of scans against a fixed model.

Back ends behind one protocol, one quality measure for all of them.
"""
