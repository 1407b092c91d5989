"""Finished runs in other programs' formats."""
