"""Files: a dataset's folder read, results written."""
