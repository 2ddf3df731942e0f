"""`diagnose` on foreign grounds: reality comes from elsewhere, and nothing in it is exactly as the model says.

| file       | what it holds                                                                                |
|------------|----------------------------------------------------------------------------------------------|
| grounds.py | the grounds, what matters on them, and how often and how large effects are hidden            |
| scenes.py  | the machines as numbers, as nominal MJCF, and which effects can sit where                    |
| stiff.py   | reality as equations of motion under LSODA                                                   |
| bullet.py  | reality in PyBullet                                                                          |
| loop.py    | either in closed loop or driven by recorded commands: command chain, encoders                |
| control.py | motions, and the controller that follows them through the nominal model                      |
| draw.py    | which cases there are, from a seed                                                           |
| make.py    | flaws below what matters, effects above it, names that are as good by simulation, the data   |
| cases.py   | folders of cases, labels apart from them                                                     |
| score.py   | scores of a ground                                                                           |

Flaws, detection, effects, sealing and the solver's runs are those of the blind benchmark (tools/studies/blind).
"""
