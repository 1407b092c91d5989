"""Runs: frames one by one or in many processes, into a folder that others read back."""
