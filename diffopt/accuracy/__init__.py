"""Accuracy against time: studies of every approximation, and benchmarks of what runs often.

========================  =====================================================
`studies`                 the protocol, and `study`
`jobs`                    surfaces, directions and truth that studies share
`output`                  tables, plots and files of their results
`diffraction`             studies of window, patch, nodes and rounding
`expansion_studies`       study of Taylor, Chebyshev and low-rank expansions
`spectral_studies`        studies of few wavelengths, and of the form of the reflectance
`table_studies`           studies of baked tables, and of the choice over coherence lengths
`material_studies`        studies of reflectances, masking, colour and tables
`energy_studies`          study of what rough facets lose
`lobe_studies`            studies of closed forms for lobes; those of fits are in `fitting`
`shadow_studies`          studies of shadow fields; `shadow_scenes`: what they are judged on
`shadow_benchmarks`       benchmarks of receivers, samples and tables of shadow fields
`transfer_studies`        studies of precomputed transfer; `transfer_scenes`: what they are judged
                          on, `transfer_truth`: by what, `transfer_runs`: pictures beside it
`transfer_estimators`     slices from shared rays, and from paths of their own
`transfer_comparison`     adaptive and even tessellations, one lobe and two
`transfer_benchmarks`     benchmarks of relighting and of slices
`validity`                the scalar models against rigorous optics
`measurement`             cost of a compiled function
`comparison`              every method on one job, in one run
`ranking`                 its rows: table, files, who beats whom
`contenders`              how its methods are set up, timed and judged
`tuning`                  those that are tuned on the truth
`nufft`                   the non-uniform FFT as a contender
`render_comparison`       levels of image synthesis against path tracing
`render_pictures`         its plot and contact sheet; `render_scenes`: its scenes
`plan_comparison`         what plans leave out, whether that is right, and what it saves
`plan_ladders`            error against time, from incremental shading to everything
`plan_scenes`             what plans are tried on; `plan_scenes_more`: those not only matte
`benchmarks`              the protocol of the benchmarks
`diffraction_benchmarks`  benchmarks of the diffraction methods
`frame_benchmarks`        benchmark of interactive frames
`render_throughput`       benchmarks of camera rays and paths
`mitsuba_scenes`          the same scenes for Mitsuba; `mitsuba_process`: where it runs;
                          `mitsuba_lobes`: Blinn-Phong, which it has not
========================  =====================================================
"""
