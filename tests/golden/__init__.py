"""What each stage makes of the tiny capture, in a few numbers, with the code that made it.

`stages.json` holds them. A stage whose results change while its key stays fails the build: its cached results would be
served after the change. A stage whose results change with its key fails too, until somebody has looked at the change
and written it down: `python -m tests.golden`. A change that leaves the results as they are needs nothing.
"""
