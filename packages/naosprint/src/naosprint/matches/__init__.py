"""Matches: two teams of agents play on a real rcssservermj, with the league's rules and its referee."""
