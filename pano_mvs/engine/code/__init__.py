"""Which code a stage reaches: functions, classes and constants, followed from one to the next without running them."""
