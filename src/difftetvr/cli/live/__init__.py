"""What the commands that are looked at live have in common: who is told how a run goes, and the viewer."""
