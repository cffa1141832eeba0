"""Parts of a file of Abaqus that its tests are made of."""

NODES = "*NODE, NSET=ALL\n1, 0., 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n70, 1, 1, 1,\n"
FIRST = "*ELEMENT, TYPE=C3D4, ELSET=BONE\n1, 1,2,3,4\n"
SECOND = "*Element, elset=skin , type=c3d4h\n2, 2, 3,\n4, 70\n*ELSET, ELSET=other, GENERATE\n1, 2, 1\n"
