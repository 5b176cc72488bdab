package afspm.client;

import com.google.gson.Gson;
import java.io.IOException;
import java.io.UncheckedIOException;
import java.nio.ByteBuffer;
import java.nio.channels.FileChannel;
import java.nio.charset.StandardCharsets;
import java.nio.file.Files;
import java.nio.file.Path;
import java.nio.file.Paths;
import java.nio.file.StandardCopyOption;
import java.nio.file.StandardOpenOption;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.Collections;
import java.util.List;
import java.util.UUID;

/** Keyed measurements happen once: the intent is on disk before the request, the result after it. */
final class KeyedResults {
    private static final Gson GSON = new Gson();
    private static final int LONGEST_KEY = 100;

    /** A measurement that was requested and is not finished. */
    static final class Intent {
        String key;
        String facts;
        int attempt;
        /** Packets up to this time belong to earlier measurements. */
        long sinceNs;
        List<String> interruptions;
        /** The parts of the target: region and shape, or position and kind. */
        double[] place;
        int rows;
        int columns;
        String kind;
    }

    /** The header of a stored measurement; the messages of its packets follow in the file. */
    static final class Kept {
        String key;
        String facts;
        List<String> interruptions;
        List<String> envelopes = new ArrayList<>();
        List<Long> timesNs = new ArrayList<>();
        List<Integer> sizes = new ArrayList<>();
        transient List<Packet> packets = new ArrayList<>();
    }

    private final Path folder;
    private Intent pending;

    /** @param stateDir of the run; empty: no measurement survives a restart */
    KeyedResults(String stateDir, String name) {
        folder = stateDir.isEmpty() ? null : Paths.get(stateDir, name + ".keyed");
        byte[] text = folder == null ? null : readOrNothing(folder.resolve("pending.json"));
        pending = text == null ? null : GSON.fromJson(new String(text, StandardCharsets.UTF_8), Intent.class);
    }

    /** Return the stored intent without a result; null if there is none. */
    Intent pending() {
        return pending;
    }

    void intend(Intent intent) {
        pending = intent;
        if (folder != null) {
            write(folder.resolve("pending.json"), Collections.singletonList(GSON.toJson(intent).getBytes(StandardCharsets.UTF_8)));
        }
    }

    /** Return the result of an earlier life or an earlier call; null if there is none. */
    Kept find(String key, String facts) {
        byte[] bytes = folder == null ? null : readOrNothing(path(key));
        if (bytes == null) {
            return null;
        }
        int end = 0;
        while (bytes[end] != '\n') {
            end++;
        }
        Kept kept = GSON.fromJson(new String(bytes, 0, end, StandardCharsets.UTF_8), Kept.class);
        if (!kept.key.equals(key) || !kept.facts.equals(facts)) {
            throw new InvalidValueException("the key " + key + " was used for another measurement: " + kept.facts);
        }
        int at = end + 1;
        for (int i = 0; i < kept.sizes.size(); i++) {
            byte[] message = Arrays.copyOfRange(bytes, at, at + kept.sizes.get(i));
            kept.packets.add(new Packet(kept.envelopes.get(i), message, kept.timesNs.get(i)));
            at += message.length;
        }
        return kept;
    }

    void fulfil(String key, String facts, List<Packet> packets, List<String> interruptions) {
        pending = null;
        if (folder == null) {
            return;
        }
        Kept kept = new Kept();
        kept.key = key;
        kept.facts = facts;
        kept.interruptions = interruptions;
        List<byte[]> parts = new ArrayList<>();
        for (Packet packet : packets) {
            kept.envelopes.add(packet.envelope());
            kept.timesNs.add(packet.timeNs());
            kept.sizes.add(packet.payload().length);
            parts.add(packet.payload());
        }
        parts.add(0, (GSON.toJson(kept) + "\n").getBytes(StandardCharsets.UTF_8));
        write(path(key), parts);
        try {
            Files.deleteIfExists(folder.resolve("pending.json"));
        } catch (IOException error) {
            throw new UncheckedIOException(error);
        }
    }

    /** @throws InvalidValueException the key can't be part of a request's id */
    static void check(String key) {
        boolean isPrintable = key.chars().noneMatch(one -> one == '/' || Character.isISOControl(one));
        if (key.isEmpty() || !isPrintable || key.getBytes(StandardCharsets.UTF_8).length > LONGEST_KEY) {
            throw new InvalidValueException("'" + key + "' can't be a key: 1 to " + LONGEST_KEY + " printable characters without '/'");
        }
    }

    private Path path(String key) {
        return folder.resolve(UUID.nameUUIDFromBytes(key.getBytes(StandardCharsets.UTF_8)) + ".result");
    }

    private static byte[] readOrNothing(Path file) {
        try {
            return Files.exists(file) ? Files.readAllBytes(file) : null;
        } catch (IOException error) {
            throw new UncheckedIOException(error);
        }
    }

    /** Write a file atomically, and flush it to the disk. */
    private static void write(Path file, List<byte[]> parts) {
        Path made = file.resolveSibling(file.getFileName() + ".new");
        try {
            Files.createDirectories(file.getParent());
            try (FileChannel channel = FileChannel.open(made, StandardOpenOption.CREATE, StandardOpenOption.TRUNCATE_EXISTING,
                    StandardOpenOption.WRITE)) {
                for (byte[] part : parts) {
                    for (ByteBuffer bytes = ByteBuffer.wrap(part); bytes.hasRemaining();) {
                        channel.write(bytes);
                    }
                }
                channel.force(true);
            }
            Files.move(made, file, StandardCopyOption.REPLACE_EXISTING, StandardCopyOption.ATOMIC_MOVE);
        } catch (IOException error) {
            throw new UncheckedIOException(error);
        }
    }
}
