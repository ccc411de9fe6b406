"""Play suites of test levels and tabulate the returns."""
