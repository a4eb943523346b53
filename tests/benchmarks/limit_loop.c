// The limit of the node benchmark: the same processes in C on rcl, with nothing in them but waiting, taking and
// publishing serialised messages, best effort. Compiled on the spot and run inside Python by limit_loop.py: some
// libraries of the ROS wheels want Python's symbols.
#define _GNU_SOURCE
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rmw/serialized_message.h>
#include <sensor_msgs/msg/joint_state.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#define MOST_ANSWERERS 4
#define NANOSECONDS 1000000000L
#define SEQUENCE_AT 8 // nanoseconds of the stamp, after the header of the encapsulation and the seconds

#define TRY(call)                                                                            \
  do {                                                                                       \
    rcl_ret_t code = (call);                                                                 \
    if (code != RCL_RET_OK) {                                                                \
      fprintf(stderr, "%s returned %d: %s\n", #call, (int)code, rcl_get_error_string().str); \
      return -1;                                                                             \
    }                                                                                        \
  } while (0)

typedef struct {
  rcl_context_t context;
  rcl_node_t node;
  rcl_publisher_t publisher;
  rcl_subscription_t inputs[MOST_ANSWERERS];
  int count;
  rcl_wait_set_t wait_set;
  rcl_serialized_message_t message;
} Loop;

static long time_ns(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return t.tv_sec * NANOSECONDS + t.tv_nsec;
}

static long now_ns(void) { return time_ns(CLOCK_MONOTONIC); }

static void sleep_until(long deadline_ns) {
  struct timespec t = {deadline_ns / NANOSECONDS, deadline_ns % NANOSECONDS};
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
}

static int open_loop(Loop *loop, const char *name, const char *output, int count, char inputs[][32]) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t init = rcl_get_zero_initialized_init_options();
  TRY(rcl_init_options_init(&init, allocator));
  loop->context = rcl_get_zero_initialized_context();
  TRY(rcl_init(0, NULL, &init, &loop->context));
  loop->node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  TRY(rcl_node_init(&loop->node, name, "", &loop->context, &node_options));
  const rosidl_message_type_support_t *type = ROSIDL_GET_MSG_TYPE_SUPPORT(sensor_msgs, msg, JointState);
  rcl_publisher_options_t out = rcl_publisher_get_default_options();
  out.qos.reliability = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT;
  out.qos.depth = 10;
  loop->publisher = rcl_get_zero_initialized_publisher();
  TRY(rcl_publisher_init(&loop->publisher, &loop->node, type, output, &out));
  rcl_subscription_options_t in = rcl_subscription_get_default_options();
  in.qos.reliability = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT;
  in.qos.depth = 1;
  loop->count = count;
  for (int i = 0; i < count; i++) {
    loop->inputs[i] = rcl_get_zero_initialized_subscription();
    TRY(rcl_subscription_init(&loop->inputs[i], &loop->node, type, inputs[i], &in));
  }
  loop->wait_set = rcl_get_zero_initialized_wait_set();
  TRY(rcl_wait_set_init(&loop->wait_set, count, 0, 0, 0, 0, 0, &loop->context, allocator));
  loop->message = rmw_get_zero_initialized_serialized_message();
  TRY(rmw_serialized_message_init(&loop->message, 256, &allocator));
  return 0;
}

// Wait for any input; 1 when there is something, 0 after the timeout.
static int wait_for_input(Loop *loop, long timeout_ns) {
  TRY(rcl_wait_set_clear(&loop->wait_set));
  for (int i = 0; i < loop->count; i++) TRY(rcl_wait_set_add_subscription(&loop->wait_set, &loop->inputs[i], NULL));
  rcl_ret_t code = rcl_wait(&loop->wait_set, timeout_ns);
  if (code == RCL_RET_TIMEOUT) return 0;
  TRY(code);
  return 1;
}

static int take(Loop *loop, int input, rmw_message_info_t *info) {
  if (rcl_take_serialized_message(&loop->inputs[input], &loop->message, info, NULL) == RCL_RET_OK) return 1;
  rcl_reset_error();
  return 0;
}

static int publish(Loop *loop, const unsigned char *state, size_t size, unsigned sequence) {
  memcpy(loop->message.buffer, state, size);
  memcpy(loop->message.buffer + SEQUENCE_AT, &sequence, sizeof sequence);
  loop->message.buffer_length = size;
  TRY(rcl_publish_serialized_message(&loop->publisher, &loop->message, NULL));
  return 0;
}

// Take what has come, mark who has answered the state with this number, and note when the last answer came, by the
// system's clock.
static void note_answers(Loop *loop, unsigned sequence, int *answered, long *arrived_ns) {
  rmw_message_info_t info = rmw_get_zero_initialized_message_info();
  for (int i = 0; i < loop->count; i++) {
    while (take(loop, i, &info)) {
      unsigned found;
      memcpy(&found, loop->message.buffer + SEQUENCE_AT, sizeof found);
      if (found != sequence) continue;
      answered[i] = 1;
      if (info.received_timestamp > *arrived_ns) *arrived_ns = info.received_timestamp;
    }
  }
}

static int all(const int *answered, int count) {
  for (int i = 0; i < count; i++) {
    if (!answered[i]) return 0;
  }
  return 1;
}

// Publish states, at deadlines or, with a rate of zero, as soon as all have answered.
// round_trips_ns gets one entry a state, 0 where no answer came in time. At deadlines it ends when the middleware has the
// answer, as our plants count it, without deadlines when the next state can go out. Returns how many deadlines were missed
// by a period or more, or -1.
long run_plant(double rate_hz, long states, int answerers, const unsigned char *state, long size, long *round_trips_ns) {
  static Loop loop;
  char topics[MOST_ANSWERERS][32];
  if (answerers > MOST_ANSWERERS) return -1;
  for (int i = 0; i < answerers; i++) snprintf(topics[i], sizeof topics[i], "effort_%d", i);
  if (open_loop(&loop, "limit_plant", "states", answerers, topics) != 0) return -1;
  size_t met = 0;
  while (met < (size_t)answerers) {
    sleep_until(now_ns() + NANOSECONDS / 20);
    TRY(rcl_publisher_get_subscription_count(&loop.publisher, &met));
    for (int i = 0; i < answerers; i++) {
      size_t publishers = 0;
      TRY(rcl_subscription_get_publisher_count(&loop.inputs[i], &publishers));
      if (publishers == 0) met = 0;
    }
  }
  long period = rate_hz > 0.0 ? (long)(1e9 / rate_hz) : 0, missed = 0, deadline = now_ns() + period;
  for (long k = 0; k < states; k++) {
    int answered[MOST_ANSWERERS] = {0};
    if (period) {
      sleep_until(deadline);
      if (now_ns() - deadline >= period) missed++;
    }
    long begun_system = time_ns(CLOCK_REALTIME), arrived = 0;
    long begun = now_ns(), patience = period ? deadline + period * 9 / 10 : begun + NANOSECONDS / 10;
    if (publish(&loop, state, size, (unsigned)k) != 0) return -1;
    while (!all(answered, answerers)) {
      long left = patience - now_ns();
      if (left <= 0) break;
      int some = wait_for_input(&loop, left);
      if (some < 0) return -1;
      if (!some) break;
      note_answers(&loop, (unsigned)k, answered, &arrived);
    }
    long round_trip = period ? arrived - begun_system : now_ns() - begun;
    round_trips_ns[k] = all(answered, answerers) ? round_trip : 0;
    deadline += period;
  }
  return missed;
}

// Send each state back, until the process is ended.
int run_answerer(int index) {
  static Loop loop;
  char topic[32], name[32], states[1][32] = {"states"};
  snprintf(topic, sizeof topic, "effort_%d", index);
  snprintf(name, sizeof name, "limit_answerer_%d", index);
  if (open_loop(&loop, name, topic, 1, states) != 0) return -1;
  for (;;) {
    if (wait_for_input(&loop, NANOSECONDS) < 0) return -1;
    while (take(&loop, 0, NULL)) TRY(rcl_publish_serialized_message(&loop.publisher, &loop.message, NULL));
  }
}
