"""Find the code that a stage uses: functions, classes and constants, followed by name without importing them."""
