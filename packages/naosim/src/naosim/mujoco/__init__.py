"""MuJoCo worlds of rcssservermj with Booster robots: in this process, and on servers."""
