"""Everything that crosses packages: contract, integration, acceptance, goldens, benchmarks and faults."""
