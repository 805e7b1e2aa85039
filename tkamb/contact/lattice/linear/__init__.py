"""The linear operator: factorisation, response of the contact nodes, the cache on disk."""
