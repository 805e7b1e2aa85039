"""What every test finds: Ctrl-C as a terminal sends it."""

import signal

# A shell that starts the tests in the background has them, and what they start, ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)
