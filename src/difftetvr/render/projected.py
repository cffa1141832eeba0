class Projected: pass
