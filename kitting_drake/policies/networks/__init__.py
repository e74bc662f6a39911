"""The networks alpha, beta, phi and psi of each method, and their weights as files."""
