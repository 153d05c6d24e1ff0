"""What is asked of this machine: processes beside this one, and signals."""
