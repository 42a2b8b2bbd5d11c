"""MuJoCo's own engine, contacts included, as a twin."""
