"""See a run and turn it around: what is drawn, the page that draws it, and its server."""
