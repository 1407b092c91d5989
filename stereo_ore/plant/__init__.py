"""Live operation: frames as they arrive, recorded first, then published; targets that expire by
themselves.
"""
