"""Pictures, the report and the live view."""
