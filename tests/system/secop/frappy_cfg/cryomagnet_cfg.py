# frappy's simulated cryostat and magnet, fast enough for a test
Node("cryomagnet.afspm", "a simulated cryostat and magnet", "tcp://0")  # noqa: F821
Mod(  # noqa: F821
    "tt", "frappy_demo.cryo.Cryostat", "cryostat",
    jitter=0.001, T_start=4.2, target=4.2, looptime=0.2, ramp=1, maxpower=20.0, heater=0.0, mode="pid",
    tolerance=0.1, window=1, timeout=900, p=40, i=10, d=2,
)  # fmt: skip
Mod("sw", "frappy_demo.modules.Switch", "heat switch", switch_on_time=1, switch_off_time=1)  # noqa: F821
Mod("mf", "frappy_demo.modules.MagneticField", "magnet", heatswitch="sw")  # noqa: F821
