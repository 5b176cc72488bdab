package afspm.client;

import com.google.gson.Gson;
import com.google.gson.JsonObject;
import com.google.gson.JsonParseException;
import com.google.gson.annotations.SerializedName;
import java.io.IOException;
import java.nio.charset.StandardCharsets;
import java.nio.file.Files;
import java.nio.file.Path;
import java.nio.file.Paths;
import java.security.GeneralSecurityException;
import java.util.Collections;
import java.util.HashMap;
import java.util.List;
import java.util.Map;
import javax.crypto.Mac;
import javax.crypto.spec.SecretKeySpec;

/** The launch line: one line of JSON that describes a program's part in an experiment. */
public final class Launch {
    private static final Gson GSON = new Gson();

    String name = "";
    Map<String, Object> settings = new HashMap<>();
    Sockets sockets;
    /** Prefixes of the envelopes subscribed to; null: all. */
    List<String> envelopes;
    Map<String, Integer> problems = new HashMap<>();
    @SerializedName("run_dir")
    String runDir = "";
    @SerializedName("state_dir")
    String stateDir = "";
    @SerializedName("beat_period_s")
    double beatPeriodS = 1;
    @SerializedName("beat_token")
    String beatToken = "";
    @SerializedName("request_timeout_s")
    double requestTimeoutS = 5;
    @SerializedName("request_retries")
    int requestRetries = 3;
    Keys keys;
    String run = "";
    boolean simulated;
    @SerializedName("sample_coordinates")
    boolean sampleCoordinates;

    /** The addresses of this process; null for sockets that it does not use. */
    static final class Sockets {
        String publish;
        List<String> subscribe = Collections.emptyList();
        String control;
        String heartbeat;
    }

    /** The CURVE key pair of this process, and the owner of the key at each address; keys as Z85 text. */
    static final class Keys {
        @SerializedName("public")
        String publicKey;
        String secret;
        /** The names of their owners, by public key. */
        Map<String, String> peers = new HashMap<>();
        /** The names of their binders, by address. */
        Map<String, String> servers = new HashMap<>();
        /** Whether every socket is encrypted. */
        boolean everywhere;

        /** Return the public key that the owner of {@code address} must have; null: the connection is plain. */
        String serverKey(String address) {
            String owner = servers.get(address);
            if (owner == null && !everywhere) {
                return null;
            }
            return peers.entrySet().stream().filter(peer -> peer.getValue().equals(owner)).map(Map.Entry::getKey).findFirst()
                    .orElseThrow(() -> new ConfigException("it is not known whose key to expect at " + address));
        }
    }

    private Launch() {
    }

    /** Read a launch line. */
    public static Launch parse(String line) {
        Launch launch;
        try {
            launch = GSON.fromJson(line, Launch.class);
        } catch (JsonParseException error) {
            throw new ConfigException("the launch line is not JSON: " + error.getMessage() + " (this program is started by `afspm run`)");
        }
        if (launch == null || launch.name.isEmpty() || launch.sockets == null) {
            throw new ConfigException("the launch line has no name or no sockets");
        }
        if (launch.keys != null && launch.keys.secret == null) {
            launch.keys = null;
        }
        return launch;
    }

    /**
     * Return the launch line of a guest that joins a running experiment.
     *
     * @param where the folder of a run, or of all runs: then the newest one
     * @param name the name shown as the holder of control
     */
    public static Launch ofGuest(String where, String name) {
        try {
            Path folder = runIn(Paths.get(where));
            JsonObject run = GSON.fromJson(text(folder.resolve("run.json")), JsonObject.class);
            if (run.get("guest") == null || !run.get("guest").isJsonObject()) {
                throw new ConfigException(folder + ": this part of the experiment can't be joined; join where its components run");
            }
            JsonObject guest = run.getAsJsonObject("guest");
            Path state = folder.resolve("state");
            guest.addProperty("name", name);
            guest.addProperty("state_dir", state.toString());
            if (Files.exists(state.resolve("guest.keys"))) {
                guest.add("keys", GSON.fromJson(text(state.resolve("guest.keys")), JsonObject.class));
            }
            return parse(guest.toString());
        } catch (IOException | JsonParseException error) {
            throw new ConfigException(where + " can't be joined: " + error);
        }
    }

    private static Path runIn(Path where) throws IOException {
        if (Files.exists(where.resolve("run.json"))) {
            return where;
        }
        if (Files.isDirectory(where.resolve("latest"))) {
            return where.resolve("latest").toRealPath();
        }
        return where.resolve(text(where.resolve("latest.txt")).trim());
    }

    private static String text(Path file) throws IOException {
        return new String(Files.readAllBytes(file), StandardCharsets.UTF_8);
    }

    /** Return the name of the component. */
    public String name() {
        return name;
    }

    /** Return the settings of the experiment file: numbers as Double. */
    public Map<String, Object> settings() {
        return Collections.unmodifiableMap(settings);
    }

    /** Return a setting as a number. */
    public double number(String setting) {
        Object value = settings.get(setting);
        if (value instanceof Number) {
            return ((Number) value).doubleValue();
        }
        throw new ConfigException(name + " needs a number as its setting '" + setting + "', not " + value);
    }

    /** Return the folder of this run. */
    public String runDir() {
        return runDir;
    }

    public boolean isSimulated() {
        return simulated;
    }

    /** Return the identity of this component's request socket: the same in every life, and secret if there are keys. */
    byte[] routingId() {
        if (keys == null) {
            return name.getBytes(StandardCharsets.UTF_8);
        }
        try {
            Mac mac = Mac.getInstance("HmacSHA256");
            mac.init(new SecretKeySpec(keys.secret.getBytes(StandardCharsets.UTF_8), "HmacSHA256"));
            StringBuilder mark = new StringBuilder();
            for (byte one : mac.doFinal(name.getBytes(StandardCharsets.UTF_8))) {
                mark.append(String.format("%02x", one));
            }
            return (name + "\0" + mark.substring(0, 16)).getBytes(StandardCharsets.UTF_8);
        } catch (GeneralSecurityException error) {
            throw new AfspmException("this Java has no HmacSHA256", error);
        }
    }
}
