package afspm.client;

import afspm.Control.ScopeState;

/** A requested scan or spectrum, and the test whether a published result matches it. Pure. */
abstract class Target<T> {
    static final double SAME = 1e-6; // of the size: finer than any controller positions
    static final double FITS = 1e-2; // of the size: a controller's rounding, not another region
    private static final double SPOT_M = 20e-9; // a scanner with sensors reports the measured position, not the requested one
    private static final double MOVED = 0.5; // of the size: with drift correction a scan is published at its registered position
    private static final double SHEARED = 0.1; // of the size: and with its registered size and angle

    final String what;
    final String start;
    final ScopeState busy;
    /** The parts by which a later life of the component recognises it. */
    final String facts;

    private Target(String what, String start, ScopeState busy, String facts) {
        this.what = what;
        this.start = start;
        this.busy = busy;
        this.facts = what + " " + facts;
    }

    /** Return the result in a packet; null if there is none. */
    abstract T of(Packet packet);

    abstract boolean fits(T result);

    /** Return the name of a part of a result: the channel of a scan. */
    abstract String nameOf(T result);

    abstract Packet packetOf(T result);

    /** A scan to take; without region or rows, those in force are used. */
    static final class OfScan extends Target<Scan> {
        final ScanParameters wanted;
        /** Positions are in sample coordinates, and a scan is published at its registered position. */
        final boolean moves;

        OfScan(ScanParameters wanted, boolean moves) {
            super("scan", "start-scan", ScopeState.SS_SCANNING, wanted.toString());
            this.wanted = wanted;
            this.moves = moves;
        }

        @Override
        Scan of(Packet packet) {
            return packet.scan();
        }

        @Override
        boolean fits(Scan scan) {
            ScanParameters taken = new ScanParameters(scan.region(), scan.rows(), scan.columns());
            Region region = wanted.region();
            if (!moves || region == null) {
                return wanted.isSetBy(taken, FITS);
            }
            boolean isClose = region.distanceM(scan.region()) <= MOVED * Math.min(region.widthM(), region.heightM());
            return isClose && new ScanParameters(region.movedTo(scan.region()), wanted.rows(), wanted.columns()).isSetBy(taken, SHEARED);
        }

        @Override
        String nameOf(Scan scan) {
            return scan.channel();
        }

        @Override
        Packet packetOf(Scan scan) {
            return scan.packet();
        }
    }

    /** A spectrum to take; without position or kind, those in force are used. */
    static final class OfSpectrum extends Target<Spectrum> {
        final double[] atM;
        final String kind;
        private final boolean moves;

        OfSpectrum(double[] atM, String kind, boolean moves) {
            super("spectrum", "start-spec", ScopeState.SS_SPEC, java.util.Arrays.toString(atM) + " " + kind);
            this.atM = atM;
            this.kind = kind;
            this.moves = moves;
        }

        @Override
        Spectrum of(Packet packet) {
            return packet.spectrum();
        }

        @Override
        boolean fits(Spectrum spectrum) {
            if (kind != null && !kind.equals(spectrum.kind())) {
                return false;
            }
            double[] there = spectrum.positionM();
            return atM == null || there == null || moves || Math.hypot(there[0] - atM[0], there[1] - atM[1]) <= SPOT_M;
        }

        @Override
        String nameOf(Spectrum spectrum) {
            return ""; // a result has one spectrum, and the next may be of another kind
        }

        @Override
        Packet packetOf(Spectrum spectrum) {
            return spectrum.packet();
        }
    }
}
