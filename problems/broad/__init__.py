"""Broad scenes composed at random by many grammars: the suites ``broad``, to train with, and ``unseen``, never trained.

A grammar is a small program that places, repeats, tilts, mirrors, nests, cuts and bends parts, and names places that
hands are sent to. Each is a level: those of furniture, containers, panels, single curved things and scattered solids
make up ``broad``; those of networks, tunnels, trees, helices, nets, machines and frameworks ``unseen``.

- ``shapes``, ``compounds``: parts and their algebra; ``surfaces``: distances, triangles and points of parts.
- ``furniture``, ``containers``, ``panels``, ``curved``, ``scattered``, ``unseen``, ``frameworks``: the grammars, which
  give a ``composition``.
- ``simple``: two levels of few obstacles that no grammar makes, ``free`` and ``alignment``.
- ``held``, ``ends``, ``difficulty``, ``representation``: held objects, starts and goals, how hard a problem is, and how
  its scene is given; ``drawing`` draws a problem of them.
"""
