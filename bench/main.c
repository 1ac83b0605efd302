/* morpho-bench: how fast and how exact the rollouts are on this machine. Called by tools/bench. */
#include "bench.h"

#include <getopt.h>
#include <string.h>

static const char usage[] =
    "Usage: morpho-bench "
    "rollout|gradient|gradient-accuracy|gradient-order|accuracy|score-error|penetration|risers|"
    "stability|"
    "space|atlas|store|stream|evolution "
    "[OPTION…]\n\n  rollout   speed of one core on 200 distinct random bodies × the paper test "
    "set, against its best sgemm rate\n  gradient  speed of one core differentiating 256 rollouts, "
    "against its best sgemm rate; memory; the back end\n  gradient-accuracy  float32 against "
    "float64 gradient of 256 rollouts\n  gradient-order  gradients at smaller and smaller time "
    "steps against their limit\n  accuracy  run time against error for integrators, control "
    "periods, precisions, impact modes and time steps, as CSV\n  score-error  estimated errors of "
    "scores against the real ones, as CSV and a summary\n  penetration  masses "
    "of robots inside their own voxels, as CSV and a summary\n  risers    energy that masses get "
    "where the ground rises, as CSV and a summary\n  stability  physics that rollouts "
    "survive, with the linear bound, as CSV and tables\n  space     speed of drawing, naming and "
    "varying random "
    "bodies\n  atlas     all bodies of at most ten voxels, their file and its queries, in a new "
    "folder in the given folder (default /tmp)\n  store     speed of durable submissions, saves "
    "and queries, in a new folder in the "
    "given folder (default /tmp)\n  stream    the distinct bodies of a pretraining run: time and "
    "memory\n  evolution  a campaign's bookkeeping without its rollouts; `morpho-bench evolution "
    "--help`\n\n  --bodies N         another number of bodies\n  --seed N           seed of the "
    "bodies' stream (default 1)\n  --workers N        threads of `accuracy`, `gradient-accuracy`, "
    "`gradient-order`, `stability` (default: one per processor)\n  --isa NAME         x86-64, avx2 "
    "or avx512 "
    "(default: the best that runs here)\n  --controller PATH  safetensors file (default "
    "data/controllers/bootstrap.safetensors)\n  --dt MS            time step of `rollout`, "
    "`gradient` and `score-error` (default 4)\n  "
    "--period MS        their control period (default: one step)\n  "
    "--integrator NAME  theirs: paper (default) or split\n  --vary             gives each world "
    "of `rollout` and `gradient` constants of its own\n  --quick            a tenth of "
    "the bodies\n  --designs FILE     robots of `penetration`, a line each (default: random "
    "bodies)\n";

static const struct {
  const char *name;
  int (*run)(const struct bench_options *options);
  int (*run_with)(int argc, char **argv); /* or this one, which gets the arguments after the name */
} benchmarks[] = {{"rollout", bench_rollout, NULL},
                  {"fleet-model", NULL, bench_fleet_model},
                  {"gradient", bench_gradient, NULL},
                  {"gradient-accuracy", bench_gradient_accuracy, NULL},
                  {"accuracy", bench_accuracy, NULL},
                  {"score-error", bench_score_error, NULL},
                  {"penetration", bench_penetration, NULL},
                  {"risers", bench_risers, NULL},
                  {"gradient-order", bench_gradient_order, NULL},
                  {"stability", bench_stability, NULL},
                  {"atlas", NULL, bench_atlas},
                  {"space", NULL, bench_space},
                  {"store", NULL, bench_store},
                  {"stream", NULL, bench_stream}};

int main(int argc, char **argv)
{
  static const struct option long_options[] = {{"bodies", required_argument, NULL, 'b'},
                                               {"seed", required_argument, NULL, 's'},
                                               {"workers", required_argument, NULL, 'w'},
                                               {"isa", required_argument, NULL, 'i'},
                                               {"controller", required_argument, NULL, 'c'},
                                               {"designs", required_argument, NULL, 'f'},
                                               {"dt", required_argument, NULL, 'd'},
                                               {"period", required_argument, NULL, 'p'},
                                               {"integrator", required_argument, NULL, 'm'},
                                               {"vary", no_argument, NULL, 'v'},
                                               {"quick", no_argument, NULL, 'q'},
                                               {"help", no_argument, NULL, 'h'},
                                               {NULL, 0, NULL, 0}};
  struct bench_options options = {
      .seed = 1, .isa = mo_isa_best(), .controller = "data/controllers/bootstrap.safetensors"};
  bench_sgemm_choose(argv);
  if (argc > 1 && strcmp(argv[1], "evolution") == 0) /* has its own options */
    return bench_evolution(argc - 1, argv + 1);
  int option;
  while ((option = getopt_long(argc, argv, "h", long_options, NULL)) != -1)
    switch (option) {
    case 'b': options.bodies = (uint32_t)bench_number(optarg, 0, 100000); break;
    case 's': options.seed = bench_number(optarg, 0, UINT64_MAX); break;
    case 'w': options.workers = (uint32_t)bench_number(optarg, 0, 1024); break;
    case 'i': options.isa = bench_isa(optarg); break;
    case 'c': options.controller = optarg; break;
    case 'f': options.designs = optarg; break;
    case 'd': options.dt_s = bench_ms(optarg); break;
    case 'p': options.control_period_s = bench_ms(optarg); break;
    case 'm':
      options.integrator = (enum mo_integrator)bench_word(mo_integrator_words, optarg);
      break;
    case 'v': options.vary = true; break;
    case 'q': options.quick = true; break;
    case 'h': fputs(usage, stdout); return 0;
    default: fputs(usage, stderr); return 2;
    }
  setvbuf(stdout, NULL, _IOLBF, 0);
  const char *name = optind < argc ? argv[optind] : "";
  for (size_t i = 0; i < sizeof(benchmarks) / sizeof(benchmarks[0]); i++) {
    if (strcmp(name, benchmarks[i].name) != 0)
      continue;
    if (options.vary && benchmarks[i].run != bench_rollout && benchmarks[i].run != bench_gradient) {
      fprintf(stderr, "morpho-bench: --vary goes with rollout or gradient, not with %s\n", name);
      return 2;
    }
    if (benchmarks[i].run_with != NULL)
      return benchmarks[i].run_with(argc - optind, argv + optind);
    if (optind + 1 == argc)
      return benchmarks[i].run(&options);
  }
  if (optind + 1 == argc)
    fprintf(stderr, "morpho-bench: unknown benchmark \"%s\"\n", name);
  else
    fputs(usage, stderr);
  return 2;
}
