"""What real drives need beyond the chapters' models: what counts, and with which noise."""
