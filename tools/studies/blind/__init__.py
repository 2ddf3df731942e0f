"""The blind benchmark of `diagnose`: data from plants that share no dynamics code with the solver, and their scores.

| file         | what it holds                                                                                 |
|--------------|-----------------------------------------------------------------------------------------------|
| plants.py    | four plants: equations of motion derived by hand, and their energy                            |
| mjcf.py      | the nominal model of each, which is all that the solver gets to see                           |
| truths.py    | what reality adds: friction, drives, transmissions, one table of neutral values               |
| integrate.py | Runge-Kutta steps with stick and slip located as events, many rows at once                    |
| excite.py    | reference motions                                                                             |
| loop.py      | controller, drive, plant and encoder in closed loop, or the plant driven by recorded commands |
| library.py   | every effect: where it can sit, how large it may be, what parameters the solver should report |
| flaws.py     | small imperfections of everything, below what matters                                         |
| detect.py    | the size at which an effect becomes detectable                                                |
| fr3.py       | the FR3 in MuJoCo with other numerics, and callbacks for what the model lacks                 |
| fr3_friction.py | dry friction of its joints by events                                                       |
| fr3_draw.py  | which cases of the FR3 there are                                                              |
| fr3_make.py  | their data                                                                                    |
| draw.py      | which cases there are, from a seed                                                            |
| made.py      | what a finished case is, on which ground, and what the labels say of its effects              |
| batch.py, make.py | the data of all cases, those of one plant together                                       |
| alike.py     | names that a case's data cannot tell apart                                                    |
| cases.py     | folders of cases, labels apart from them, the hash of the labels                              |
| solve.py     | runs `diagnose` on the folders                                                                |
| features.py, baselines.py | simpler ways to name an effect, for comparison                                   |
| score.py, plots.py | scores with intervals, confusion matrix, power curves                                   |
"""
