"""Buckets and web servers as places of logs and results."""
