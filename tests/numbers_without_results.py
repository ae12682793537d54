"""Numbers on the pages that no results.json contains: phrases by page and by the reason why not."""

SETTING, DEFINITION, ELSEWHERE, UNSTORED, DATE = (
    "a setting in the code of the study",
    "part of a definition or of a level that is stated, not measured",
    "published by others",
    "measured once, by a command that stores no results",
    "a date of results that are older than the code",
)
WITHOUT_RESULTS = {
    "README.md": {
        ELSEWHERE: ("van de Wouw (1997)", "Kluwer, 1997, 191-198", "BSD-3-Clause"),
        SETTING: ("Python ≥ 3.11",),
    },
    "docs/benchmarks.md": {
        SETTING: (
            "Duffing, ζ = 0.5 %", "two ensembles of 64 walkers", "of 64 walkers on two cores", "not 50 times",
            "A value above 1 means",
        ),
        UNSTORED: (
            "(AMD EPYC, Zen 5)", "took 1.2 to 1.4 times as long as here", "missed there by 12 to 33 %",
            "some 45 functions of the solver, in two processes of some 4 s each",
            "time is spread over 8,950 tests", "those of 8,950; the 11,616 of later", "took 791 s with a full cache",
            "takes 15 s of one core once per machine", "64 walkers at once |",
            "Duffing | 1 | 160 | 0.93 | 1.2", "Duffing, folded | 1 | 800 | 1.1 | 2.0", "damper | 1 | 1600 | 1.2 | 2.3",
            "gear, force | 2 | 800 | 1.8 | 1.8", "gear, force, folded | 2 | 800 | 1.9 | 2.4",
            "van der Pol | 1 | 200 | 1.0 | 1.1", "coupled van der Pol | 2 | 200 | 1.0 | 1.6",
            "Rössler | 3 | 400 | 1.1 | 1.7",
            "takes 1.4 times as long with the kernels of any size, other estimates 0.9 to 1.1 times",
            "for the other times set `UNROLLED_STATES` to 0",
            "takes 0.46 s of 1.2 s of processor time, Numba 0.39 s, NumPy 0.12 s", "special functions 0.10 s",
            "with them it took 2.4 s (another machine than that of the table, medians of eleven runs)",
            "of 769 MB (828 MB with scikit-learn", "LLVM takes 173, SciPy 143, pandas 84", "SymPy 80, NumPy 73",
            "images 88, Numba 35, h5py 18, xarray 18, pip 17",
        ),
    },
    "docs/explanation/adequacy.md": {
        SETTING: ("the upper end of the 90 % interval of its error is below 2 %",),
        DEFINITION: (
            "by Holm's method, is below 1 %", "is called misspecified is at most 1 %",
            "as with 7 values and 3 parameters",
        ),
    },
    "docs/explanation/frequency_error.md": {
        SETTING: (
            "force and response with noise of 2 %, 90 % intervals of the stiffness at", "= 200", "= 50",
            "and 20 cycles contain",
        ),
        DEFINITION: ("with 90 %. ", "`frequency_se` > 0"),
    },
    "docs/explanation/identifiability.md": {
        DEFINITION: ("have a probability above 2.5 %", "has more than 1 % of the mass", "have less than 1 % of the"),
    },
    "docs/explanation/independent_values.md": {SETTING: ("A mean period on 800 grid points",)},
    "docs/explanation/laplace_mcmc.md": {
        DEFINITION: (
            "both ends of the 90 % interval", "above 0.7 Laplace is", "is 50 autocorrelation times long",
            "is at most 1.005 and their 5, 50 and 95 % quantiles", "92 for a median of 5000 and a spread of 2",
            "48 % for a tenth of the prior", "one with 3 % of the posterior mass",
            "No mixture describes it in 20 dimensions. Where a tau above 50", "after 250 steps of the burn-in",
        ),
    },
    "docs/explanation/paper.md": {
        ELSEWHERE: ("A. de Kraker, G. Verbeek, N. van de Wouw (1997)",),
        DEFINITION: ("schemes of order 2 and 4", "parameters of (7)"),
    },
    "docs/explanation/why_periodic.md": {ELSEWHERE: ("used this in 1997",)},
    "docs/how_to/populations.md": {
        SETTING: (
            "Units above 0.7, or with fewer than 50 effective draws", "Of each unit 2,000 draws are kept",
            "posteriors of 20,000 draws", "sample of 1,000 files",
        ),
        DEFINITION: (
            "That determines the spread to 2 %, and the mean to 3 % of the spread", "At a false-alarm rate of 1 %",
        ),
    },
    "docs/how_to/calibrate.md": {
        DEFINITION: ("A 90 % interval should", "(above 1: intervals too narrow)", "coverage at 50, 80, 90 and 95 %"),
    },
    "docs/how_to/chaotic_recordings.md": {
        SETTING: ("a recording of 3,000 drive periods",),
        DEFINITION: (
            "a false-alarm rate of 1 %", "stretches need 10 forcing periods", "false-alarm rate 0.1 %",
            "not determined to 1 % of a return",
        ),
        UNSTORED: (
            "The orbits of periods 1 to 4 of a simulated beam, with 5,100 points in three coordinates, take 0.5 to 1.1",
            "and 1.4 to 2.2 s with three",
        ),
    },
    "docs/how_to/clocks.md": {
        ELSEWHERE: ("differ by 1 to 100 ppm",),
        DEFINITION: (
            "Over 300 cycles, 20 ppm turn the phase by 2°", "false-alarm rate is 1e-4",
            "condition number of the normal equations at most 20", "below 0.05 cycles", "| | 1 | |",
            "−3 dB at the cutoff", "less than 5 % of a harmonic",
        ),
        SETTING: ("0.7 s …", "as after 7 lost samples",),
    },
    "docs/how_to/export.md": {
        ELSEWHERE: ("0.23 with Python 3.11 and 1.x with later versions",),
        DEFINITION: ("files above 2 GiB need",),
    },
    "docs/how_to/failing_solves.md": {
        DEFINITION: ("equal values of all states: 1, 0.1, 10, 0.01 and so on",),
        SETTING: ("whatever the factor 0.2",),
        UNSTORED: (
            "From 15 cycles of Lotka and Volterra's model with noise of 0.05",
            "recovers a = 1, b = 0.5, c = 0.2, d = 0.8 to 4 · 10⁻⁵ and the energy, 0.2433, to 10⁻⁴",
        ),
    },
    "docs/how_to/good_recording.md": {
        DEFINITION: (
            "biases them by more than 5 % of the signal", "jumps by 2π, 360, 1, or the range",
            "harmless below 1.5 % of the amplitude", "harmless below 0.5 % of the amplitude",
            "2 to 63 levels with so little noise",
        ),
    },
    "docs/how_to/noisy_inputs.md": {DEFINITION: ("warns from 0.3 on", "false-alarm rate of 1 %")},
    "docs/how_to/period_doubled.md": {
        SETTING: ("response periods of 1 to 8 drive periods",),
        DEFINITION: (
            "at multiples of 1/P of the drive", "with a false-alarm rate of 1 % over all periods",
            "only lines with 20 times the power", "They have at least 1e-4 of the channel",
            "a subharmonic of 1 % of the signal", "not at 50, 60, 100, 120, 150 or 180 Hz",
            "the tests allow 1 %", "where more than 0.5 % of",
        ),
        UNSTORED: ("Of 400 simulated recordings of period one",),
    },
    "docs/how_to/priors.md": {DEFINITION: ("a spread of 0.7 is a factor of two",)},
    "docs/how_to/my_model.md": {ELSEWHERE: ("(MATLAB, version 1.3)", "(Python, pyHarm-os 1.2.2)")},
    "docs/how_to/noise_model.md": {
        UNSTORED: ("90 % intervals contain the truth in 82 to 86 %; with three and more in 89 to 94 %",),
    },
    "docs/how_to/response_tables.md": {
        SETTING: ("a harmonic force of 0.1 N", "amplitudes are known to 1 %"),
        DEFINITION: ("phases folded into ±90°",),
    },
    "docs/how_to/files.md": {
        SETTING: ("or by its number from 1", "given by their number, from 1", "more than 1 ppm"),
        ELSEWHERE: (
            "UTF-8 with or without byte order mark, UTF-16 with one, cp1252", "which is 2.6 ppm long",
            "51.2 kHz is written as 1.95313E-05 s", "Excel stores (1 µs)", "of data set 164", "one data set 58",
            "ID line 1", "MDF files, versions 2 to 4", "the lists of SEP 005",
        ),
        DEFINITION: (
            "numbers such as 1,234, for dates such as 03/12/2026,", '"12:+Z"', "Intervals such as 0.0025 s",
            "the reciprocal of 256 Hz", "so that 8, 16, 24 and 32 bits", '"channel 1", "channel 2"', '"data[:, 2]"',
            '"segment 1", "segment 2"', '"group 2"',
        ),
    },
    "docs/how_to/read_my_data.md": {
        SETTING: ("version 5 and 7.3", "grid points per period, 800 by default", "or their numbers from 1"),
        ELSEWHERE: (
            "dates after ISO 8601", "milliseconds since 1970",
        ),
        DEFINITION: (
            "divided by 60, multiplied by 2π, by π/180", "multiplied by 9.80665", "steps of 1000 or more",
            r"10\*\*(level/20) for amplitudes",
            r"10\*\*(level/10) for powers", "gives no data of harmonic 0",
        ),
    },
    "docs/how_to/running.md": {
        SETTING: ("the scheduler's own address instead of 127.0.0.1", "128 processes"),
        UNSTORED: (
            "a replicate takes 0.8 to 1.3 s of one core, an empty task 5 ms, and the pickled problem has 5 kB",
            "At 5 ms a task it handles 200 tasks a second, which is enough for 160 to 260 workers",
            "10,000 replicates would take 50 s instead of 8 to 13 s",
            "(5 MB in total) and writing 200 lines a second (0.8 kB each)",
        ),
    },
    "docs/how_to/sampler.md": {SETTING: ("after at least 50 steps",)},
    "docs/how_to/solve_periodic.md": {
        UNSTORED: (
            "on 800 points: a batch takes twice as long, and errors are 300 to 1000 times smaller",
            "5 | 100 | 8.4 | -7.4 % | 1.10, -0.1 %", "10 | 400 | 73 | -5.2 % | 1.10, 0.0015 %",
            "10 | 800 | 2.25 | -1.3 % | 1.000001, < 0.0001 %", "20 | 1600 | 789 | -4.3 % | 1.08, -0.002 %",
            "mu up to 20) the period was right to 0.4 %",
        ),
        DEFINITION: (
            "has a multiplier 1", "is from 1 shows", "Above 0.1", "as the trivial one is to 1",
            "exceeds 5 % of its range", "(index 1)",
        ),
    },
    "docs/how_to/wrong_model.md": {
        DEFINITION: ("Its 90 % interval takes the noise",),
        UNSTORED: (
            "contained the true error in 90 % of 120 data sets, and the upper end was below it in 7 %",
        ),
    },
    "docs/reference/messages.md": {
        DEFINITION: ("more than 1 % of the posterior mass", "a saved result above 2 GiB", "autonomous orbit is not 1"),
        ELSEWHERE: ('"utf-8", "latin-1", "cp1252" or "utf-16"'),
    },
    "docs/start/install.md": {SETTING: ("Python 3.11 or newer",), ELSEWHERE: ("mode 0700",)},
    "docs/start/tour.md": {SETTING: ("one mean period with 1600 grid points",)},
    "docs/studies/calibration.md": {
        DEFINITION: ("90 % intervals, MCMC",),
        "computed in tests/diagnostics/test_calibration.py": (
            "detected in 99.2 % of calibrations with 1000 replicates, with the latter alone in 76 %",
        ),
    },
    "docs/studies/clocks.md": {
        SETTING: (
            "with noise of 2 % of force and displacement", "from 0 to 0.01 cycles in a cycle",
            "15 minutes on two cores", "with another seed it is 551 of 600",
            "30 to 90 % of their samples missing", "800 amplitudes each",
        ),
        DEFINITION: ("Coverage of 90 % intervals by Q/cycles", "probability of 99 %"),
    },
    "docs/studies/coverage.md": {
        DEFINITION: (
            "Do 90 % intervals contain the truth in 90 % of data sets", "with a probability of 99 %",
            "of the binomial distribution that 99 % of right intervals are in",
            "differ by more than 1.96 standard deviations in", "5 % would be expected", "with 95 % confidence",
            "which should be 1", "That a share is below 8 %",
            "that it is above 1 %", "above the band by at most 1 %", "Of 81 shares",
            "3 cycles; AR(0.9)", "from the residuals of 13", "compared with 15 harmonics",
        ),
        UNSTORED: ("2 of 16 by Laplace and 0 by the robust ones, with both, 5 and 1 of 20",),
        SETTING: (
            "30 minutes of processor time",
        ),
    },
    "docs/reference/still_wrong.md": {
        UNSTORED: (
            "rounded below 0.05", "comes out as -1.48 ± 0.01, the model has -1.34 with this friction and -1.52 without",
            "and the recording has 1,000 returns", "with noise of 0.3 % of its range",
            "on 400 points takes 0.26 ms, a posterior of three parameters 10 s of processor time",
            "four such units 58 s", "which takes 0.18 ms there",
        ),
        SETTING: ("the tests are to find 90 %",),
    },
    "docs/start/limit_cycles.md": {SETTING: ("below 10 mm",)},
    "docs/reference/elements.md": {
        DEFINITION: (
            "99.5 % of the limit at three times", "lowers the maximum by up to 7 %", "slip by 0.1 % below their limit",
            "within −10 … 5 % of the power law",
        ),
    },
    "docs/studies/damper.md": {ELSEWHERE: ("doi 10.5281/zenodo.4445334",)},
    "docs/studies/diode.md": {
        SETTING: ("Alternations of less than 1 % of the variance",),
        UNSTORED: ("by up to 1.9, and gives 0.7 ± 0.7 and 4.0 ± 2.7 for the two differences",),
    },
    "docs/studies/flutter.md": {ELSEWHERE: ("K. H. Lee, D. A. W. Barton, L. Renson, 2023",)},
    "docs/studies/landing_gear.md": {
        SETTING: (
            "A gas charge lower by 2 %, friction by 20 % and oil leaked by 1 %", "at a false-alarm rate of 1 % a gear",
            "at a true value of 2", "the experiment at 6 Hz lies outside",
        ),
    },
    "docs/studies/noisy_inputs.md": {SETTING: ("noise of 1, 3 and 10 % of the input's rms",)},
    "docs/studies/silverbox.md": {ELSEWHERE: ("T. Wigren, J. Schoukens, 2013",)},
    "docs/studies/verdicts.md": {DATE: ("(counted on 21 November 2026)",)},
    "docs/explanation/response_tables.md": {
        SETTING: (
            "by default 10⁻⁴ of", "if that is larger than 10⁻⁴",
            "Tables take 64 points per period by default, or 32 for",
        ),
    },
    "docs/studies/recordings.md": {
        SETTING: (
            "noise, 5 to 300 cycles of 20 to 200 samples", "recordings of 60 cycles with noise of 1 %",
            "a finding names it in 90 % of the recordings", "20 minutes on two cores",
        ),
    },
    "docs/studies/resonance.md": {
        UNSTORED: ("80 minutes of processor time",),
        SETTING: (
            "A sweep up has 33 rows", "are 1 % of the largest amplitude", "Coverage of 90 % intervals",
            "with a probability of 99 %", "and its 90 % intervals",
        ),
        ELSEWHERE: ("Oscillations, 1979",),
    },
    "docs/studies/harvester.md": {
        SETTING: (
            "in 120 pieces of 4 s", "errors below 4 % of", "free runs over 30 periods", "The force of degree 7 is",
            "The posterior of degree 7,",
            "of three states in 120 pieces", "those of periods 1 to 4 whose multiplier is below 100",
            "within 8 % of their range", "The 90 % error bars",
        ),
        UNSTORED: ('was "consistent", with 24 of 200 runs', "38, 42 and 43 of 200 left"),
        ELSEWHERE: ("Cunha Jr, 2025", "CC BY-NC-ND 4.0"),
    },
    "docs/studies/structure.md": {
        SETTING: (
            "of 50 finite elements", "at 0.4 of its length", "noise of 0.02 N and 0.1 m/s²", "of 10 to 300 degrees",
            "1.5 to 2 times off", "90 % interval |", "up to 4096 points", "within 0.05 of its limit",
            "the stop within 20 µm",
        ),
    },
}  # fmt: skip
