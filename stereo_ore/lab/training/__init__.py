"""Training of what is learned: the adaptive filter's scorers, the models of lumps, the solids'
shape prior.
"""
