"""What `python -m cavin_pyro.data` does with datasets: info, verify, merge, export."""
