#!/usr/bin/env bash
# A scene on ranks of several machines: sbatch deploy/slurm.sh dam-break [OPTION OF `warp-lcp run`...]
# The working folder, where out/NAME comes to lie, must be on a file system that all machines share. Sent again, it goes on where it was.
#SBATCH --job-name=warp-lcp
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=4
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=2G
#SBATCH --time=04:00:00
#SBATCH --signal=USR1@120
#SBATCH --open-mode=append
# A rank is a task of one thread; docs/planning.md says what memory it takes. The signal ends the run after its step, with a checkpoint.
set -euo pipefail
scene=${1:?usage: sbatch deploy/slurm.sh SCENE [OPTION...]}
shift
read -ra program <<<"${WARP_LCP:-warp-lcp}" # WARP_LCP="apptainer exec warp-lcp.sif warp-lcp" for a container
out=out/$(basename "$scene" .toml)
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

if [ -e "$out/run.json" ]; then set -- "$@" --resume; fi
# its PMIx must be one that the MPI of mpi4py knows: `srun --mpi=list`
exec srun --mpi=pmix --kill-on-bad-exit=1 "${program[@]}" run "$scene" --engine petsc --out "$out" "$@"
