"""What all suites share: clocks and paired comparisons, the machine, records, reports with plots, and comparisons of results."""
