"""A page to send: a folder or one file that shows a run in any browser, without a server and without a network."""
