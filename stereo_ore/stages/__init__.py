"""The stages of the chain: each one pure function, none knows another."""
