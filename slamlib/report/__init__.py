"""The report: HTML pages and a PDF from executed notebooks."""
