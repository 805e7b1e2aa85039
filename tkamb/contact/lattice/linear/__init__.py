"""The linear operator: factorisation, response of the contact nodes, what is kept on disk."""
