package afspm.client;

import com.google.protobuf.Timestamp;

/** Times as nanoseconds since the Unix epoch. */
final class Time {
    private static final long NS_PER_S = 1_000_000_000L;

    private Time() {
    }

    static long ns(Timestamp time) {
        return time.getSeconds() * NS_PER_S + time.getNanos();
    }

    static Timestamp timestamp(long ns) {
        return Timestamp.newBuilder().setSeconds(Math.floorDiv(ns, NS_PER_S)).setNanos((int) Math.floorMod(ns, NS_PER_S)).build();
    }

    /** Return the end of a timeout in seconds on the clock of {@link System#nanoTime}; {@link Long#MAX_VALUE}: never. */
    static long deadline(double seconds) {
        return seconds < 1e9 ? System.nanoTime() + (long) (seconds * NS_PER_S) : Long.MAX_VALUE;
    }

    /** Return the end of a timeout, or {@code deadline} if that comes first. */
    static long earlier(double seconds, long deadline) {
        return Math.min(deadline(seconds), deadline);
    }

    static boolean isOver(long deadline) {
        return System.nanoTime() >= deadline;
    }
}
