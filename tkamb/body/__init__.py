"""The rigid-body side: chain, loads, ligaments, muscles and inverse dynamics."""
