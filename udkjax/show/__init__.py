"""What people see: pictures and tables."""
