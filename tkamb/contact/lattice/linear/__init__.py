"""The linear operator: factorisation, compliance of the contact nodes, cache on disk."""
