"""The agent on-line, faster than real time: scenarios with known truth go directly into `Pipeline.step`.

    from benchmarks.online.config import building_config
    from benchmarks.online.runner import Run, visits
    from hw.virtual.building import Building, BuildingParameters

    building = Building(BuildingParameters(elsewhere=0.05), seed=1)
    run = Run(building_config(building), directory=None)  # a directory: recorded, `fieldcal replay` gives the same
    for event in visits(building, range(24)):  # a day, one window per hour
        for result in run.feed(event):
            print(result)
    print(building.truth(run.now_s).offset)
    run.close()

`python -m benchmarks.online [NAME ...] [--write]` runs the scenarios and prints their tables; `--write` puts them into
docs/online-evidence.md.
"""
